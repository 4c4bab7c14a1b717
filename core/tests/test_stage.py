"""The stage goes where it is told or says why not, whatever happens to cable, power and controller on the way."""

import contextlib
import random
import subprocess
import sys
import threading
import time
from dataclasses import replace

import pytest

from strandscope.core.errors import StrandscopeError
from strandscope.core.rig.controller import GRBL, GRBLHAL, ControllerConfig, stage_config, start_controller
from strandscope.core.rig.plan import Place, Plan
from strandscope.core.rig.stage import PositionLost, Stage, StageAlarm, StageError, StageLate, StageLost, StageRefused, StageStopped
from strandscope.core.rig.wiring import StageConfig, complaints, load_stage

HALF_STEP = Place(0.5 / 40 + 1e-3, 0.5 / 400 + 1e-3)
NEAR = {"abs": 2e-3}
RIGS = [(GRBL, "pty"), (GRBL, "tcp"), (GRBLHAL, "pty"), (GRBLHAL, "tcp")]


@contextlib.contextmanager
def rig(firmware=GRBL, transport="tcp", factor=80.0, home=True, tell=None, others=None, **config):
    """A controller, and a stage on it that is homed."""
    config = ControllerConfig(firmware=firmware, time_factor=factor, **config)
    with start_controller(config, transport) as controller, Stage.open(stage_config(controller.url, config, **(others or {})), tell) as stage:
        if home:
            stage.home()
        yield stage, controller


def true(stage, controller, place=None):
    """Whether the rig really is where the stage says, or at a place."""
    said, is_at = place or stage.position(), controller.place(stage.config)
    return all(abs(s - t) <= near for s, t, near in zip(said, is_at, HALF_STEP, strict=True))


def until(condition, what):
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.002)


# ---- going places ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("firmware", "transport"), RIGS)
def test_a_plan_is_gone_through_and_nothing_moves_when_it_has_arrived(firmware, transport):
    plan = Plan(angles_deg=(0.0, 90.0, 180.0, 270.0), first_mm=-2.0, step_mm=0.2, count=10, check_shots=False)
    with rig(firmware, transport) as (stage, controller):
        assert stage.complaints(plan) == []
        for exposure in plan:
            place = stage.move_to(*exposure.place, approach_deg=plan.approach_deg, approach_mm=plan.approach_mm, settle_s=plan.settle_s)
            begin = time.monotonic()
            assert place == pytest.approx(exposure.place, **NEAR)
            assert true(stage, controller, exposure.place)
            assert not controller.moved(begin - plan.settle_s / 80, time.monotonic())


@pytest.mark.parametrize("mask", [0, 1, 2, 3])
def test_it_stands_where_it_says_in_every_form_of_reports(mask):
    with rig(settings={10: mask}) as (stage, controller):
        assert stage.move_to(30, 5) == pytest.approx((30, 5), **NEAR)
        assert true(stage, controller)
        stage._exchange(["G92X77Y5"], 1.0, "an offset")  # that somebody has set
        assert stage.move_to(40, -5) == pytest.approx((40, -5), **NEAR)
        assert true(stage, controller)


def test_axes_may_be_turned_around_and_geared():
    others = {"focus_mm_per_unit": -0.5, "focus_axis": "Z", "turntable_deg_per_unit": 2.0, "turntable_axis": "X", "turntable_origin": -80.0}
    with rig(others=others) as (stage, controller):
        low = stage.move_to(0, -10)
        first = controller.state["truth"]
        high = stage.move_to(60, 10)
        second = controller.state["truth"]
        assert (low.position_mm, high.position_mm) == pytest.approx((-10, 10), **NEAR)
        assert second["Z"] - first["Z"] == pytest.approx(-40, **NEAR)
        assert second["X"] - first["X"] == pytest.approx(30, **NEAR)


def test_every_position_is_reached_from_below():
    with rig() as (stage, controller):
        stage.move_to(10, 0)
        for target in (5, 5.2, 5.2, 1.0, 4.0):
            motions = len(controller.motions())
            stage.move_to(10, target, approach_mm=0.5)
            two_legs = len(controller.motions()) - motions
            assert true(stage, controller, Place(10, target))
            assert two_legs <= 1 + (target == 1.0)


def test_before_homing_it_does_not_move():
    with rig(home=False) as (stage, controller):
        with pytest.raises(PositionLost, match="home"):
            stage.move_to(0, 0)
        with pytest.raises(StageAlarm):
            stage.jog(position_mm=1)
        assert controller.motions() == []


def test_without_homing_the_controllers_zero_is_the_mark():
    with rig(settings={22: 0, 20: 0}, others={"homing": False, "focus_origin": 0.0, "turntable_origin": 0.0}) as (stage, controller):
        assert stage.status().place == Place(0, 0)
        stage.move_to(30, 5)
        with pytest.raises(PositionLost, match="no switch"):
            stage.home()
        stage.assume(Place(100, 7))
        assert stage.position() == pytest.approx((100, 7))
        before = controller.state["truth"]["X"]
        stage.move_to(100, 8)
        assert controller.state["truth"]["X"] - before == pytest.approx(1, **NEAR)


# ---- jog, hold, stop -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("firmware", [GRBL, GRBLHAL])
def test_a_jog_is_cancelled_where_it_is_and_a_move_may_follow_at_once(firmware):
    with rig(firmware, factor=20) as (stage, controller):
        stage.move_to(20, -10)
        stage.jog(position_mm=40)
        until(lambda: stage.status().place.position_mm > -9, "the jog begins")
        place = stage.cancel_jog()
        assert -9 < place.position_mm < 30
        assert true(stage, controller)
        stage.jog(angle_deg=5)
        stage.move_to(20, 0)
        assert true(stage, controller, Place(20, 0))
        with pytest.raises(StageRefused, match="travel") as told:
            stage.jog(position_mm=100)
        assert told.value.code == 15


def test_a_controller_that_is_idle_but_deaf_is_nudged():
    with rig() as (stage, controller):
        controller.deafen()
        stage.move_to(0, 7)
        assert true(stage, controller, Place(0, 7))


@pytest.mark.parametrize("firmware", [GRBL, GRBLHAL])
def test_a_hold_is_no_delay_that_counts(firmware):
    said = []
    with rig(firmware, others={"slack_s": 0.4, "slack": 1.0}, tell=said.append) as (stage, controller):
        stage.move_to(0, -30)
        went = []
        mover = threading.Thread(target=lambda: went.append(stage.move_to(0, 30)))
        mover.start()
        until(lambda: controller.moving, "it begins")
        stage.hold()
        until(lambda: not controller.moving, "it halts")
        halted = controller.place(stage.config)
        assert -30 < halted.position_mm < 30
        time.sleep(1.2)  # longer than the motion may take
        assert mover.is_alive()
        assert controller.place(stage.config) == halted
        stage.resume()
        mover.join(10)
        assert went == [pytest.approx((0, 30), **NEAR)]
        assert any("held" in line for line in said)


@pytest.mark.parametrize("firmware", [GRBL, GRBLHAL])
def test_hold_and_resume_alone(firmware):
    with rig(firmware, factor=30) as (stage, controller):
        stage.move_to(0, -10)
        stage.jog(position_mm=30)
        stage.hold()  # ends a jog
        assert stage.status().state == "Idle"
        stage.hold()
        assert stage.status().state == "Hold"
        stage.resume()
        assert stage.status().state == "Idle"
        assert true(stage, controller)


@pytest.mark.parametrize("firmware", [GRBL, GRBLHAL])
def test_a_stop_keeps_the_position_and_a_reset_does_not(firmware):
    with rig(firmware) as (stage, controller):
        for end, known in ((stage.stop, True), (stage.reset, False)):
            stage.move_to(0, -30)
            caught = []

            def go(caught=caught):
                try:
                    stage.move_to(0, 30)
                except StageError as error:
                    caught.append(error)

            mover = threading.Thread(target=go)
            mover.start()
            until(lambda: controller.moving, "it begins")
            end()
            mover.join(10)
            assert isinstance(caught[0], StageStopped)
            assert stage.known == known
            assert stage.recover() == known
            assert true(stage, controller)


# ---- alarms ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("firmware", "transport"), RIGS)
def test_a_soft_limit_is_said_and_keeps_the_position(firmware, transport):
    with rig(firmware, transport) as (stage, controller):
        stage.move_to(30, 10)
        with pytest.raises(StageAlarm, match="soft limits") as told:
            stage.move_to(30, 80)
        assert told.value.code == 2
        assert stage.recover() is True
        assert stage.move_to(30, 11) == pytest.approx((30, 11), **NEAR)
        assert true(stage, controller)


@pytest.mark.parametrize("firmware", [GRBL, GRBLHAL])
@pytest.mark.parametrize("code", [1, 3])
def test_an_alarm_that_loses_the_position_is_homed(firmware, code):
    with rig(firmware) as (stage, controller):
        stage.move_to(0, -30)
        catch = threading.Timer(0.05, lambda: controller.press("reset") if code == 3 else controller.alarm(code))
        catch.start()
        with pytest.raises(StageAlarm) as told:
            stage.move_to(0, 30)
        assert told.value.code == code
        with pytest.raises(PositionLost):
            stage.position()
        assert stage.recover() is False
        stage.move_to(0, 0)
        assert true(stage, controller, Place(0, 0))


def test_a_switch_that_is_not_found_is_said():
    with rig(home=False) as (stage, controller):
        controller.alarm(9)
        with pytest.raises(StageAlarm, match="no switch was found"):
            stage.home()
        assert not stage.known
        stage.home()
        assert true(stage, controller)


def test_homing_that_is_off_is_said():
    with rig(home=False, settings={22: 0, 20: 0}) as (stage, _), pytest.raises(StageRefused, match=r"\$22=1") as told:
        stage.home()
    assert told.value.code == 5


# ---- cables and power ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("firmware", "transport"), RIGS)
def test_a_pulled_cable_is_noticed_and_survived(firmware, transport):
    said = []
    with rig(firmware, transport, tell=said.append) as (stage, controller):
        stage.move_to(10, -30)
        threading.Timer(0.05, controller.pull_cable).start()
        with pytest.raises(StageLost, match="cable"):
            stage.move_to(10, 30)
        assert controller.moving or controller.place(stage.config).position_mm > 29  # it does not know, and goes on
        with pytest.raises(StageLost, match="recover"):
            stage.position()
        threading.Timer(0.3, controller.plug_in).start()
        assert stage.recover(20) is True
        assert any("cannot be opened" in line for line in said)
        assert true(stage, controller, Place(10, 30))
        stage.move_to(10, 0)
        assert true(stage, controller, Place(10, 0))


@pytest.mark.parametrize("firmware", [GRBL, GRBLHAL])
def test_a_cable_that_is_pulled_where_it_stands_costs_nothing(firmware):
    with rig(firmware) as (stage, controller):

        def pull():
            controller.pull_cable()
            with pytest.raises(StageLost):
                stage.position()
            controller.plug_in()
            assert stage.recover(20) is True
            assert true(stage, controller)

        pull()  # homed, and nothing else
        stage.move_to(0, 5)
        pull()
        with pytest.raises(StageAlarm):
            stage.move_to(0, 90)
        stage.recover()
        pull()
        stage.stop()
        pull()


@pytest.mark.parametrize(("firmware", "transport"), RIGS)
def test_a_controller_that_restarted_unseen_is_homed(firmware, transport):
    with rig(firmware, transport) as (stage, controller):
        stage.move_to(10, -30)
        controller.pull_cable()
        controller.power_cycle()
        with pytest.raises(StageLost):
            stage.move_to(10, 30)
        time.sleep(0.1)  # its welcome is said to nobody
        controller.plug_in()
        assert stage.recover(20) is False
        assert stage.move_to(10, -20) == pytest.approx((10, -20), **NEAR)
        assert true(stage, controller)


def test_a_controller_that_restarted_unseen_and_needs_no_homing_is_not_believed():
    with rig(settings={22: 0, 20: 0}, others={"homing": False}) as (stage, controller):
        stage.move_to(stage.position().angle_deg + 10, stage.position().position_mm)
        controller.pull_cable()
        controller.power_cycle()
        time.sleep(0.1)
        controller.plug_in()
        with pytest.raises((StageLost, PositionLost)):
            stage.move_to(10, 30)
        with pytest.raises(PositionLost):
            stage.recover(20)
        with pytest.raises(PositionLost):
            stage.move_to(0, 0)


def test_a_power_cut_in_a_motion_is_said_and_homed():
    with rig() as (stage, controller):
        stage.move_to(0, -30)
        threading.Timer(0.05, controller.power_cycle).start()
        with pytest.raises((PositionLost, StageAlarm)):
            stage.move_to(0, 30)
        assert not stage.known
        assert stage.recover() is False
        stage.move_to(0, 5)
        assert true(stage, controller, Place(0, 5))


def test_a_board_that_restarts_when_its_port_is_opened_is_waited_for():
    with rig(transport="pty", resets_on_open=True) as (stage, controller):
        stage.move_to(0, 5)
        assert true(stage, controller)
        controller.pull_cable()
        with pytest.raises(StageLost):
            stage.move_to(0, 6)
        controller.plug_in()
        assert stage.recover(20) is False
        assert true(stage, controller)


def test_a_turntable_without_a_switch_stays_where_it_stood():
    with rig(switches="XZ", others={"turntable_homes": False, "turntable_origin": 0.0}, settings={20: 0}) as (stage, controller):
        angle = stage.position().angle_deg
        stage.move_to(angle + 30, 0)
        stood = controller.state["truth"]["Y"]
        controller.power_cycle()
        with pytest.raises((PositionLost, StageAlarm)):
            stage.move_to(angle + 30, 5)
        assert stage.recover() is False
        assert stage.position().angle_deg == pytest.approx(angle + 30, **NEAR)
        stage.move_to(angle + 40, 0)
        assert controller.state["truth"]["Y"] - stood == pytest.approx(10, **NEAR)
        threading.Timer(0.02, controller.power_cycle).start()
        with pytest.raises((PositionLost, StageAlarm)):
            stage.move_to(angle + 300, 0)
        with pytest.raises(PositionLost, match="turntable"):  # it was turning: nobody knows how far
            stage.recover()
        assert not stage.known


def test_silence_is_noticed():
    with rig(others={"silent_s": 0.3}) as (stage, controller):
        controller.silence(2.0)
        begin = time.monotonic()
        with pytest.raises(StageLost, match="no answer"):
            stage.move_to(0, 10)
        assert time.monotonic() - begin < 2.0
        assert stage.recover(20) in (True, False)
        stage.move_to(0, 10)
        assert true(stage, controller, Place(0, 10))


def test_noise_never_makes_it_believe_a_wrong_position():
    """Four bytes in a thousand are lost or changed. It may give up, and then says so; where it says that it is, it is."""
    with rig(others={"slack_s": 1.0}) as (stage, controller):
        arrived, rng = 0, random.Random(5)
        controller.noise(0.004)
        for _ in range(30):
            place = Place(rng.randrange(0, 90), rng.randrange(-20, 20))
            try:
                assert stage.move_to(*place) == pytest.approx(place, **NEAR)
                arrived += 1
                assert true(stage, controller, place)
            except StageError:
                with contextlib.suppress(StageError):
                    stage.recover(5)
        assert stage.garbage > 10
        assert arrived > 15
        controller.noise(0.0)
        stage.recover(20)
        assert true(stage, controller)


def test_garbage_between_answers_is_ignored():
    with rig() as (stage, controller):
        for k in range(10):
            controller.garbage(30)
            stage.move_to(k, k)
            assert true(stage, controller, Place(k, k))
        assert stage.garbage > 0


def test_without_a_port_to_open_pyserial_is_not_asked_for():
    code = "import strandscope.core.rig.stage, strandscope.core.rig.controller, sys; assert 'serial' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# ---- the port --------------------------------------------------------------------------------------------------------

QUICK = {"welcome_s": 0.3, "silent_s": 0.3, "poll_s": 0.02}


@pytest.mark.parametrize("url", ["loop://", "/dev/strandscope-none", "socket://127.0.0.1:1", "nothing://x", "COM77"])
def test_a_port_without_a_controller_is_said_with_its_name(url):
    with pytest.raises(StageLost) as told:
        Stage.open(StageConfig(url=url, **QUICK))
    assert str(told.value).startswith(url)


def test_a_port_has_one_master():
    with rig(transport="pty") as (stage, _), pytest.raises(StageLost, match="no other program"):
        Stage.open(stage.config)


def test_half_a_line_of_a_program_before_does_not_move_it():
    config = ControllerConfig(time_factor=40)
    with start_controller(config, "tcp") as controller:
        with Stage.open(stage_config(controller.url, config)) as first:
            first.home()
            first.move_to(0, 0)
            first._wire.write(b"G53G1X-8")
        with Stage.open(stage_config(controller.url, config)) as second:
            assert second.status().state == "Idle"  # homed by the first, and it has not restarted
            assert not second.known
            second.home()
            second.move_to(0, 1)
            assert true(second, controller, Place(0, 1))


def test_inches_and_missing_axes_are_refused():
    for others, settings, match in (({}, {13: 1}, r"\$13=0"), ({"turntable_axis": "A"}, {}, "no axis A")):
        config = ControllerConfig(time_factor=40, settings=settings)
        with start_controller(config, "tcp") as controller, pytest.raises(StageError, match=match):
            Stage.open(stage_config(controller.url, config, **others))


def test_many_lines_never_overflow_the_buffer():
    with rig(factor=200) as (stage, controller):
        stage._stream([f"G53G1X{-40 - k % 2:.4f}F900" for k in range(100)] + ["G4P0.01"], 60.0, "all", "all", False)
        assert len(controller.motions()) > 1
        assert stage.position().position_mm == pytest.approx(stage.config.focus_mm_per_unit * (-41 - stage.config.focus_origin), **NEAR)


# ---- the shutter line ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("firmware", "others", "name"),
    [
        (GRBL, {}, "coolant"),
        (GRBL, {"shutter_on": "M3 S1000", "shutter_off": "M5"}, "spindle"),
        (GRBL, {"shutter_inverted": True}, "coolant"),
        (GRBLHAL, {"shutter_on": "M64 P1", "shutter_off": "M65 P1"}, "port 1"),
    ],
)
def test_the_shutter_line_is_switched_only_where_it_stands(firmware, others, name):
    with rig(firmware, others=others) as (stage, controller):
        inverted = stage.config.shutter_inverted
        if inverted:
            stage.output(False)  # closes the coil, which opens the line
        stage.move_to(0, 10)
        stage.output(True)
        stage.output(False)
        stage.jog(position_mm=5)
        stage.pulse(0.4)
        events = [(when, on) for when, what, on in controller.switched() if what == name]
        assert [on for _, on in events] == [not inverted, inverted] * 2 if not inverted else [True] + [False, True] * 2
        assert events[-1][0] - events[-2][0] == pytest.approx(0.4 / 80, abs=0.005)
        for when, _ in events:
            assert not controller.moved(when - 1e-4, when + 1e-4)


def test_an_output_that_the_firmware_does_not_have_is_said():
    with rig(others={"shutter_on": "M64 P0", "shutter_off": "M65 P0"}) as (stage, _), pytest.raises(StageRefused, match="output"):
        stage.output(True)


# ---- settings --------------------------------------------------------------------------------------------------------

GOOD = {1: "255", 20: "1", 22: "1", 32: "0"} | {
    number + axis: value
    for number, values in {100: ("400", "40", "400"), 110: ("900", "3600", "900"), 130: ("90", "400", "90")}.items()
    for axis, value in enumerate(values)
}
FITS = StageConfig(focus_origin=-45.0, turntable_origin=-385.0)


@pytest.mark.parametrize(
    ("changes", "config", "named"),
    [
        ({}, {}, None),
        ({1: "25"}, {}, "$1=255"),
        ({22: "0"}, {}, "$22=1"),
        ({20: "0"}, {}, "$20=1"),
        ({32: "1"}, {"shutter_on": "M3"}, "$32=0"),
        ({100: "10"}, {}, "$100"),
        ({100: "0"}, {}, "$100"),
        ({110: "100"}, {}, "$110"),
        ({111: "100"}, {}, "$111"),
        ({130: "60"}, {}, "$130"),
        ({131: "300"}, {}, "$131"),
        ({}, {"focus_origin": 0.0}, "focus_origin"),
        ({}, {"turntable_origin": 0.0}, "turntable_origin"),
        ({100: "1e9", 110: "1e9"}, {}, "$100"),
    ],
)
def test_settings_that_do_not_fit_the_plan_are_named(changes, config, named):
    said = complaints(GOOD | changes, replace(FITS, **config), "Y", Plan())
    assert bool(said) == (named is not None)
    assert named is None or named in " ".join(said)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("port = 'COM3'", "stage.port"),
        ("url = ''", "url"),
        ("focus_axis = 'Q'", "focus_axis"),
        ("turntable_axis = 'X'", "turntable_axis"),
        ("focus_mm_per_unit = 0", "focus_mm_per_unit"),
        ("poll_s = 0", "poll_s"),
        ("homing = 'yes'", "homing"),
        ("shutter_on = 'M8!'", "shutter_on"),
        ("baud = 9600.5", "baud"),
    ],
)
def test_a_wrong_file_is_told_by_field(text, named, tmp_path):
    (tmp_path / "rig.toml").write_text(f"[stage]\n{text}\n")
    with pytest.raises(StrandscopeError) as told:
        load_stage(tmp_path / "rig.toml")
    assert str(tmp_path / "rig.toml") in str(told.value)
    assert named in str(told.value)


def test_a_file_says_how_the_rig_is_wired(tmp_path):
    (tmp_path / "rig.toml").write_text("[plan]\nangles = 4\n[stage]\nurl = 'COM3'\nfocus_axis = 'Z'\nshutter_inverted = true\n")
    assert load_stage(tmp_path / "rig.toml") == StageConfig(url="COM3", focus_axis="Z", shutter_inverted=True)


def test_lateness_tells_what_it_waited_for():
    with rig(others={"slack_s": 0.1, "slack": 0.001}) as (stage, _), pytest.raises(StageLate, match=r"waited .* for the stage to reach"):
        stage.move_to(*stage.position(), settle_s=60)  # it stands, and answers late
