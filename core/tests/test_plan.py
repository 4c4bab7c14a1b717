"""A plan is data that iterates into exposures; every place is reached from below, and its file says what is wrong with it."""

import itertools
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from strandscope.core.errors import StrandscopeError
from strandscope.core.rig.plan import Lash, Place, Plan, approach, bracketed, load_plan, save_plan, turntable_plan

SMALL = Plan(angles_deg=(0.0, 90.0, 180.0), first_mm=-1.0, step_mm=0.5, count=5)


def test_without_a_word_it_is_the_papers():
    plan = Plan()
    assert len(set(plan.angles_deg)) == 24
    assert plan.positions_mm[-1] - plan.positions_mm[0] == pytest.approx(75)
    assert plan.count / 75 == pytest.approx(5, rel=0.01)
    swept = [e for e in plan if e.kind == "sweep"]
    assert len(swept) == 24 * 376
    assert len(plan) == len(list(plan)) == 24 * 377  # and a check shot a sweep


def test_exposures_are_counted_in_order_and_checks_repeat_the_first():
    exposures = list(SMALL)
    assert [e.index for e in exposures] == list(range(len(SMALL)))
    for _, sweep in itertools.groupby(exposures, key=lambda e: e.sweep):
        first, *_, last = sweep
        assert (last.kind, last.place) == ("check", first.place)
        assert first.kind == "sweep"
    assert len(replace(SMALL, check_shots=False)) == 15


def test_the_turntable_sequence_goes_once_around_with_a_small_aperture():
    plan = turntable_plan()
    assert len(plan) == 360
    assert {e.kind for e in plan} == {"turntable"}
    assert {e.position_mm for e in plan} == {0.0}
    assert plan.angles_deg[1] == pytest.approx(1.0)
    assert plan.f_number > Plan().f_number


@given(st.floats(-30, 30), st.floats(0, 40), st.floats(0, 3), st.floats(0.05, 2))
def test_a_bracket_covers_the_hair_and_hardly_more(far, depth, margin, step):
    plan = bracketed(replace(SMALL, step_mm=step), far + depth, far, margin)
    assert plan.first_mm <= far - margin + 1e-5
    assert plan.last_mm >= far + depth + margin - 1e-5
    assert plan.last_mm - plan.first_mm <= depth + 2 * margin + step + 1e-5


def test_what_is_left_costs_less():
    costs = [(SMALL.duration_s(start=k), SMALL.disk_bytes(k)) for k in range(len(SMALL) + 1)]
    assert costs == sorted(costs, reverse=True)
    assert costs[-1] == (0, 0)
    assert SMALL.disk_bytes() == 18 * SMALL.bytes_each
    assert SMALL.duration_s() > 18 * (SMALL.settle_s + SMALL.shutter_s + SMALL.transfer_s)
    assert SMALL.duration_s(speed_mm_s=1) > SMALL.duration_s(speed_mm_s=10)


# ---- backlash --------------------------------------------------------------------------------------------------------


def played(legs, screw, play):
    """Where a carriage with play stands after the legs, if its screw goes there: it lags behind by the play when it goes down."""
    for leg in legs:
        screw = min(max(screw, leg), leg + play)
    return screw


@given(st.lists(st.integers(-100, 100), min_size=1, max_size=12), st.integers(0, 20), st.integers(0, 20))
def test_play_up_to_the_approach_moves_no_photograph(targets, play, begins):
    least, lash, at = 20.0, Lash(), Place(0, 0)
    carriage = float(begins % (play + 1))  # anywhere in its play
    for target in targets:
        legs, lash = approach(at, Place(0, target), lash, Place(0, least))
        carriage = played([leg.position_mm for leg in legs], carriage, play)
        assert carriage == legs[-1].position_mm == target
        at = Place(0, target)


def test_a_sweep_goes_up_without_going_back():
    legs = [legs for legs, _ in SMALL.moves()]
    assert [len(leg) for leg in legs[1:5]] == [1, 1, 1, 1]
    for moves, exposure in SMALL.moves():
        assert moves[-1] == exposure.place


def test_the_reach_holds_every_move():
    least, most = SMALL.reach
    places = [leg for legs, _ in SMALL.moves() for leg in legs]
    assert min(places) >= least
    assert all(least.position_mm <= p.position_mm <= most.position_mm and least.angle_deg <= p.angle_deg <= most.angle_deg for p in places)


# ---- files -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plan", [Plan(), SMALL, turntable_plan(36)])
def test_a_file_holds_the_plan(plan, tmp_path):
    save_plan(tmp_path / "plan.toml", plan, stage={"url": "COM3"})
    assert load_plan(tmp_path / "plan.toml") == plan


def test_a_file_says_only_what_is_unusual(tmp_path):
    (tmp_path / "plan.toml").write_text("[plan]\nangles = 8\nstep_mm = 0.1\n[stage]\nurl = 'COM3'\n")
    plan = load_plan(tmp_path / "plan.toml")
    assert plan == replace(Plan(), angles_deg=tuple(45.0 * k for k in range(8)), step_mm=0.1)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[plan]\nstep = 1", "plan.step "),
        ("[plan]\nstep_mm = 0", "plan.step_mm"),
        ("[plan]\nstep_mm = 'much'", "plan.step_mm"),
        ("[plan]\nstep_mm = nan", "plan.step_mm"),
        ("[plan]\ncount = 2.5", "plan.count"),
        ("[plan]\ncount = true", "plan.count"),
        ("[plan]\nangles_deg = [0, 0]", "plan.angles_deg"),
        ("[plan]\nangles_deg = []", "plan.angles_deg"),
        ("[plan]\nangles = 0", "plan.angles"),
        ("[plan]\nangles = 4\nangles_deg = [0]", "plan.angles"),
        ("[plan]\nkind = 'film'", "plan.kind"),
        ("[plan]\ncheck_shots = 1", "plan.check_shots"),
        ("[plan]\niso = -1", "plan.iso"),
        ("[plan]\nsettle_s = -1", "plan.settle_s"),
        ("count = 3", "count"),
        ("[plan", "TOML"),
    ],
)
def test_a_wrong_file_is_told_by_field(text, named, tmp_path):
    path = tmp_path / "plan.toml"
    path.write_text(text)
    with pytest.raises(StrandscopeError, match=r"expected|not valid") as told:
        load_plan(path)
    assert str(path) in str(told.value)
    assert named in str(told.value)


def test_a_file_that_is_not_there_is_told(tmp_path):
    with pytest.raises(StrandscopeError, match="not found"):
        load_plan(tmp_path / "none.toml")


def test_a_plan_that_cannot_be_is_refused_at_once():
    with pytest.raises(StrandscopeError, match="step_mm"):
        Plan(step_mm=-0.2)
    with pytest.raises(StrandscopeError, match="near"):
        bracketed(SMALL, -1, 1)
