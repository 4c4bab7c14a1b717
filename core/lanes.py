"""Eight floats at once, where numba's loops do not get there by themselves: rows of a filter are too short for its vectoriser.

What is added to what is written out here, so a kernel that uses this gives the same bits wherever it is compiled.
"""

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

LANES = 8


def _index(_given) -> types.Type:
    """Any integer becomes one of the size of a pointer."""
    return types.intp


def _lanes(operation: str):
    """An intrinsic that adds or subtracts (``fadd``, ``fsub``) eight floats of an array and eight read backwards."""

    def lanes(_typing, out, at, array, first, last):
        def code(context, builder, signature, args):
            into, index, held, begin, end = args
            vector = ir.VectorType(ir.FloatType(), LANES)

            def place(of, array, index):
                pointer = builder.gep(context.make_array(of)(context, builder, array).data, [index])
                return builder.bitcast(pointer, vector.as_pointer())

            def loaded(index):
                value = builder.load(place(signature.args[2], held, index))
                value.align = 4
                return value

            order = ir.Constant(ir.VectorType(ir.IntType(32), LANES), list(range(LANES - 1, -1, -1)))
            back = loaded(builder.sub(end, ir.Constant(end.type, LANES - 1)))
            back = builder.shuffle_vector(back, ir.Constant(vector, ir.Undefined), order)
            stored = builder.store(getattr(builder, operation)(loaded(begin), back), place(out, into, index))
            stored.align = 4
            return context.get_dummy_value()

        return types.void(out, _index(at), array, _index(first), _index(last)), code

    return intrinsic(lanes)


add_backwards = _lanes("fadd")
"""add_backwards(out, at, array, first, last): out[at : at + 8] = array[first : first + 8] + array[last : last - 8 : -1],
of contiguous float32 arrays (n,); nothing checks that these places exist."""

subtract_backwards = _lanes("fsub")
"""The same with a minus."""
