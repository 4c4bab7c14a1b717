"""The simulated controller does what GRBL's documents say, in GRBL's words; and knows where the stage really is."""

import time

import pytest
import serial
from hypothesis import given, settings
from hypothesis import strategies as st

from strandscope.core.errors import StrandscopeError
from strandscope.core.rig import grbl
from strandscope.core.rig.controller import GRBL, GRBLHAL, Controller, ControllerConfig, Machine, start_controller
from strandscope.core.rig.grbl import Garbage, Report, parse_line


class Told:
    """A machine and its clock, without a port."""

    def __init__(self, firmware=GRBL, home=True, **others):
        self.machine, self.now = Machine(ControllerConfig(firmware=firmware, **others)), 0.0
        self.after(0.0)
        if home:
            self.says("$H", 100.0)

    def after(self, seconds: float) -> list[str]:
        self.now += seconds
        return [line for line in self.machine.advance(self.now).decode().split("\r\n") if line]

    def send(self, data: bytes) -> list[str]:
        self.machine.receive(data)
        return self.after(0.0)

    def says(self, line: str, seconds: float = 0.0) -> list[str]:
        self.machine.receive(line.encode() + b"\n")
        return self.after(seconds)

    @property
    def report(self) -> Report:
        (line,) = self.send(b"?")
        return parse_line(line.encode())


@pytest.fixture(params=[GRBL, GRBLHAL])
def told(request):
    return Told(request.param)


# ---- the firmware ----------------------------------------------------------------------------------------------------


def test_it_is_locked_until_homed():
    told = Told(home=False)
    assert told.report.state == "Alarm"
    assert told.says("G1X-5F100") == ["error:9"]
    assert told.says("$H") == []
    assert told.send(b"?") == []  # GRBL does not answer while homing
    assert told.after(100.0)[-1] == "ok"
    assert told.report.machine == (-1, -1, -1)


def test_motions_take_the_time_of_their_ramps(told):
    told.says("G53G1X-31F600")  # 30 mm at 10 mm/s, 60 mm/s²
    seconds = 30 / 10 + 10 / 60
    told.after(seconds - 0.01)
    assert told.report.state == "Run"
    told.after(0.02)
    assert told.report.state == "Idle"
    begin, end = told.machine.motions[-1]
    assert end - begin == pytest.approx(seconds)


@settings(deadline=None, max_examples=60)
@given(st.lists(st.tuples(st.sampled_from("XYZ"), st.floats(-80, -1), st.floats(20, 3000)), min_size=1, max_size=6), st.floats(0.01, 3))
def test_it_comes_to_where_it_is_sent_however_time_is_cut(moves, cut):
    told = Told()
    for axis, target, feed in moves:
        assert told.says(f"G53G1{axis}{target:.3f}F{feed:.0f}", cut) == ["ok"]
    told.says("G4P0", 1000.0)
    assert told.report.state == "Idle"
    for axis, value in {axis: target for axis, target, _ in moves}.items():
        assert told.machine.truth[axis] == pytest.approx(value, abs=0.5 / told.machine.settings[100 + "XYZ".index(axis)] + 1e-3)
    for begin, end in told.machine.motions:
        assert begin < end


def test_dwell_and_outputs_wait_for_the_motion(told):
    assert told.says("G53G1X-11F600") == ["ok"]
    assert told.says("G4P1") == []
    assert told.says("M8") == []
    assert told.after(1.1) == []
    assert told.after(1.2) == ["ok", "ok"]
    assert told.machine.outputs[-1][0] >= told.machine.motions[-1][1] + 1
    assert told.says("$G")[0].split()[7 + (told.machine.hal) * 3] == "M8"


def test_a_hold_keeps_the_position_and_a_resume_goes_on(told):
    told.says("G53G1X-31F600", 1.0)
    told.send(b"!")
    assert told.report.state == "Hold"
    assert told.report.substate == 1
    told.after(1.0)
    held = told.report
    assert (held.state, held.substate) == ("Hold", 0)
    told.after(5.0)
    assert told.report.machine == held.machine
    told.send(b"~")
    told.after(5.0)
    assert told.report.state == "Idle"
    assert told.report.machine[0] == -31


def test_a_reset_in_motion_loses_the_position_and_in_a_hold_does_not(told):
    told.says("G53G1X-31F900", 1.0)
    told.send(b"!")
    told.after(1.0)
    said = told.send(b"\x18")
    assert parse_line(said[0].encode()) == parse_line(b"Grbl 1.1h") or "rbl" in said[0]
    assert told.report.state == "Idle"
    told.says("G53G1X-31F900", 0.5)
    said = told.send(b"\x18")
    assert said[0] == "ALARM:3"
    assert told.report.state == "Alarm"
    assert told.machine.truth["X"] != pytest.approx(told.machine.counter["X"], abs=1e-3)
    assert told.says("$X") == ["[MSG:Caution: Unlocked]", "ok"]


def test_after_a_soft_limit_only_a_reset_is_heard():
    told = Told()
    assert told.says("G53G1X-91F600") == ["ALARM:2"]
    assert told.send(b"\x18") == []  # it is still calling out
    assert told.after(1.0) == ["[MSG:Reset to continue]"]
    assert told.send(b"?") == []
    assert told.says("$X") == []
    said = told.send(b"\x18")
    assert said[:2] == ["ok", "Grbl 1.1h ['$' for help]"]  # ok to what it has not done
    assert told.report.state == "Alarm"
    told.says("$X")
    assert told.report.machine == (-1, -1, -1)


def test_a_soft_limit_in_a_motion_halts_it_first():
    told = Told()
    assert told.says("G53G1X-31F600", 1.0) == ["ok"]
    assert told.says("G53G1X-91F600") == []
    assert "ALARM:2" in told.after(1.0)
    assert -31 < told.machine.truth["X"] < -1
    assert told.machine.truth["X"] == pytest.approx(told.machine.counter["X"])


def test_jogs_lock_out_lines_and_are_cancelled(told):
    assert told.says("$J=G91G21X-20F600") == ["ok"]
    assert told.report.state == "Jog"
    assert told.says("G4P0") == ["error:9"]
    told.after(0.5)
    told.send(b"\x85")
    told.after(1.0)
    assert told.report.state == "Idle"
    assert -20 < told.report.machine[0] < -2
    assert told.says("$J=G91G21X20F600") == ["error:15"]


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("G1X-5", 22),
        ("G4", 28),
        ("G1A5F100", 20),
        ("$J=X1F5M8", 16),
        ("G99", 20),
        ("12", 1),
        ("G1X-F9", 2),
        ("$Q", 3),
        ("G1X-1X-2F9", 25),
        ("G0G1X-2", 21),
    ],
)
def test_lines_are_refused_as_grbl_does(line, code):
    assert Told().says(line) == [f"error:{code}"]


def test_the_buffer_of_received_bytes_is_as_small_as_grbls():
    told = Told()
    for _ in range(17):  # one runs, 15 are planned, one waits
        told.says(f"G53G1X{-31 + _ % 2}F300")
    told.machine.receive(b"G4P0\n" * 40)  # 200 bytes
    assert told.after(1000.0).count("ok") < 40


def test_work_coordinates_are_reported_where_they_are_asked_for():
    told = Told()
    told.says("$10=2")
    told.says("G92X5")
    first, second = told.report, told.report
    assert (first.machine, first.work[0], first.offset[0]) == (None, 5, -6)
    assert (second.offset, second.bytes_free) == (None, 128)


@settings(deadline=None, max_examples=100)
@given(st.lists(st.tuples(st.binary(max_size=40), st.floats(0, 2)), max_size=12), st.sampled_from([GRBL, GRBLHAL]))
def test_whatever_it_is_told_it_answers_in_its_own_words(parts, firmware):
    told = Told(firmware)
    said = []
    for data, seconds in parts:
        said += told.send(data) + told.after(seconds)
    told.send(b"\x18")
    said += told.after(2000.0)
    assert not [line for line in said if isinstance(parse_line(line.encode()), Garbage)]
    assert told.report.state in grbl.STATES


@settings(deadline=None, max_examples=40)
@given(
    st.lists(
        st.sampled_from(["G53G1X-9F600\n", "G53G1X-50F900\n", "G53G1Y-9F900\n", "G4P1\n", "M8\n", "!", "~", "?", "$J=G91X-1F600\n"]), max_size=15
    )
)
def test_no_output_is_switched_while_it_moves(parts):
    told = Told()
    for part in parts:
        told.send(part.encode())
        told.after(0.3)
    told.send(b"~")
    told.after(500.0)
    for when, _, _ in told.machine.outputs:
        assert not any(begin < when < end for begin, end in told.machine.motions)


# ---- the process -----------------------------------------------------------------------------------------------------

FAST = ControllerConfig(time_factor=40)


def reports(port, count=1):
    seen = []
    end = time.monotonic() + 10
    while len(seen) < count and time.monotonic() < end:
        port.write(b"?")
        line = port.read_until(b"\n")
        if isinstance(parse_line(line), Report):
            seen.append(parse_line(line))
    return seen


@pytest.mark.parametrize("transport", ["pty", "tcp"])
def test_a_port_is_pulled_out_and_comes_back_under_its_name(transport):
    with start_controller(FAST, transport) as controller:
        port = serial.serial_for_url(controller.url, timeout=0.2)
        assert reports(port)
        controller.pull_cable()
        with pytest.raises((OSError, serial.SerialException)):
            reports(port)
        inner = getattr(port, "_socket", None)
        port.close()
        if inner:
            inner.close()  # pyserial leaves it open where the other end is gone
        with pytest.raises((OSError, serial.SerialException)):
            serial.serial_for_url(controller.url)
        controller.plug_in()
        with serial.serial_for_url(controller.url, timeout=0.2) as port:
            assert reports(port)


def test_it_tells_when_it_moved_in_the_time_of_the_clock():
    with start_controller(FAST, "tcp") as controller:
        before = time.monotonic()
        with serial.serial_for_url(controller.url, timeout=5.0) as port:
            port.write(b"$H\n")
            while port.read_until(b"\n") != b"ok\r\n":
                pass
        after = time.monotonic()
        ((begin, end),) = controller.motions()
        assert before < begin < end < after
        assert controller.moved(before, after)
        assert not controller.moved(before - 9, begin)
        assert not controller.moved(end, after)
        assert not controller.moving


def test_others_can_go_on_with_it_and_it_can_be_told_to_end():
    controller = start_controller(FAST, "tcp")
    other = Controller(controller.url, controller.control, controller.pid)
    assert other.state["state"] == "Alarm"
    other.end()
    with pytest.raises(StrandscopeError, match="does not run"):
        _ = controller.state


def test_noise_and_silence_come_on_demand():
    with start_controller(FAST, "tcp") as controller, serial.serial_for_url(controller.url, timeout=0.2) as port:
        controller.garbage(30)
        port.write(b"?")
        assert len(port.read(200)) > 60
        controller.noise(0.2)
        port.write(b"$$\n")
        lines = [line for line in port.read(2000).split(b"\r\n") if line]
        assert sum(isinstance(parse_line(line), Garbage) for line in lines) > len(lines) / 5
        controller.noise(0.0)
        controller.silence(1.0)
        port.write(b"?")
        assert port.read(10) == b""
