"""What a controller says is read as its documents define it; and what is not exactly so is garbage, and tells no position."""

import itertools
import re
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from strandscope.core.rig import grbl
from strandscope.core.rig.grbl import Alarm, Empty, Error, Feedback, Garbage, Lines, Ok, Report, Setting, Startup, Track, Welcome, follow, parse_line

MESSAGES = (Welcome, Ok, Error, Alarm, Report, Setting, Feedback, Startup, Empty, Garbage)

SAID = [
    (b"ok", Ok()),
    (b"ok\r\n", Ok()),
    (b"error:20", Error(20)),
    (b"error: Undefined feed rate", Error(0, "Undefined feed rate")),
    (b"ALARM:2", Alarm(2)),
    (b"ALARM: Hard limit", Alarm(0, "Hard limit")),
    (b"", Empty()),
    (b"Grbl 1.1h ['$' for help]", Welcome("1.1h")),
    (b"GrblHAL 1.1f ['$' or '$HELP' for help]", Welcome("1.1f")),
    (b"$100=250.000", Setting(100, "250.000")),
    (b"$100=250.000 (x, step/mm)", Setting(100, "250.000")),
    (b"$23=3 (homing dir invert mask", Setting(23, "3")),
    (b"$70=", Setting(70, "")),
    (b"$N0=G54", Startup("$N0=G54")),
    (b">G54:ok", Startup("G54:ok")),
    (b"[MSG:'$H'|'$X' to unlock]", Feedback("MSG", "'$H'|'$X' to unlock")),
    (b"[GC:G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0]", Feedback("GC", "G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0")),
    (b"[OPT:V,15,128]", Feedback("OPT", "V,15,128")),
    (b"[G54:0.000,0.000,0.000]", Feedback("G54", "0.000,0.000,0.000")),
    (b"[PRB:0.000,0.000,0.000:0]", Feedback("PRB", "0.000,0.000,0.000:0")),
    (b"<Idle|MPos:1.000,-2.500,0.000|FS:0,0>", Report("Idle", machine=(1.0, -2.5, 0.0), feed=0.0)),
    (b"<Run|WPos:1.000,2.000,0.000|F:300.|WCO:5.000,0.000,0.000>", None),
    (b"<Run|WPos:1.000,2.000,0.000|F:300|WCO:5.000,0.000,0.000>", Report("Run", work=(1.0, 2.0, 0.0), offset=(5.0, 0.0, 0.0), feed=300.0)),
    (b"<Hold:0|MPos:0.000,0.000,0.000|Bf:14,128|FS:0,0>", Report("Hold", 0, (0.0, 0.0, 0.0), blocks_free=14, bytes_free=128, feed=0.0)),
    (
        b"<Door:1|MPos:0.000,0.000,0.000|Ln:99|FS:0,0|Pn:XZD|Ov:100,50,100|A:SF>",
        Report("Door", 1, (0.0, 0.0, 0.0), feed=0.0, overrides=(100, 50, 100), pins="XZD", accessories="SF"),
    ),
    (b"<Jog|MPos:0.000,0.000,0.000,22.500|Bf:35,1023|FS:900,0,0|H:1|TLR:0|In:-1|SD:1>", None),
    (b"<Alarm:11|MPos:0.0000,0.0000,0.0000,0.0000|AR|FW:grblHAL>", Report("Alarm", 11, (0.0,) * 4)),
    (b"<Idle|MPos:1.000,2.000,3.00|FS:0,0>", Garbage),  # a figure is missing
    (b"<Idle|MPos:1.000,2.0000,3.000e5|FS:0,0>", Garbage),
    (b"<Idle|MPos:1.000,2.000,3.000|FS:0,0", Garbage),
    (b"<Idle|MPos:1.000,2.000,3.000|FS:0,0>>", Garbage),
    (b"<Idel|MPos:1.000,2.000,3.000|FS:0,0>", Garbage),
    (b"<Idle|MPos:1.000,2.000,3.000|MPos:1.000,2.000,4.000>", Garbage),
    (b"<Idle|MPos:1.000,2.000,3.000|WPos:1.000,2.000,3.000>", Garbage),
    (b"<Idle|MPos:1.000,2.000,3.000|WCO:0.000,0.000>", Garbage),
    (b"<Idle|MPos:nan,2.000,3.000|FS:0,0>", Garbage),
    (b"<Idle|FS:0,0>", Garbage),
    (b"<Idle>", Garbage),
    (b"<Idle|MPos:1.000,2.000,3.000|Bf:15|FS:0,0>", Garbage),
    (b"okay", Garbage),
    (b"rror:9", Garbage),
    (b"error:", Garbage),
    (b"ALARM:2x", Garbage),
    (b"ok\x00", Garbage),
    (b"\xff\xfe", Garbage),
]


@pytest.mark.parametrize(("line", "meant"), SAID, ids=lambda v: v.decode("latin-1") if isinstance(v, bytes) else "")
def test_each_form_is_read_as_what_it_is(line, meant):
    read = parse_line(line)
    if meant is Garbage:
        assert read == Garbage(line)
    elif meant is None:
        assert isinstance(read, Report | Garbage)
    else:
        assert read == meant


def test_fields_that_are_not_known_are_kept_and_harm_nothing():
    read = parse_line(b"<Jog|MPos:0.000,0.000,0.000,22.500|Bf:35,1023|FS:900,0|H:1,3|TLR:0|In:-1|SD:1|New>")
    assert read.machine == (0, 0, 0, 22.5)
    assert read.others == {"H": "1,3", "TLR": "0", "In": "-1", "SD": "1", "New": ""}


@given(st.binary(max_size=200))
def test_whatever_comes_is_some_message(line):
    assert isinstance(parse_line(line), MESSAGES)


@given(st.text("<>|:.,-0123456789IdleRunMPosWC OFS$[]ok", max_size=80))
def test_what_looks_like_a_report_is_one_or_garbage(text):
    read = parse_line(text.encode())
    assert isinstance(read, MESSAGES)
    if isinstance(read, Report):
        assert text.startswith("<")
        assert text.endswith(">")
        assert (read.machine is None) != (read.work is None)


@given(st.binary(max_size=6000), st.lists(st.integers(0, 6000), max_size=8))
def test_lines_do_not_depend_on_how_bytes_are_cut(data, cuts):
    whole = Lines().feed(data)
    lines, pieces = Lines(), sorted({0, len(data), *(c for c in cuts if c < len(data))})
    cut = [line for a, b in itertools.pairwise(pieces) for line in lines.feed(data[a:b])]
    if all(len(line) <= grbl.LONGEST_ANSWER for line in data.split(b"\n")):
        assert cut == whole == data.split(b"\n")[:-1]
    assert len(lines._rest) <= grbl.LONGEST_ANSWER


# ---- positions -------------------------------------------------------------------------------------------------------

numbers = st.integers(-999_999, 999_999).map(lambda n: n / 1000)
places = st.tuples(numbers, numbers, numbers)


def report(state: str, machine, offset=(0, 0, 0), work=False, tell=False, more=""):
    at = [m - o for m, o in zip(machine, offset, strict=True)] if work else machine
    numbers = ",".join(f"{v:.3f}" for v in at)
    wco = "|WCO:" + ",".join(f"{v:.3f}" for v in offset) if tell else ""
    return f"<{state}|{'WPos' if work else 'MPos'}:{numbers}|FS:0,0{wco}{more}>".encode()


def heard(lines):
    track = Track()
    for line in lines:
        track = follow(track, parse_line(line))
    return track


@given(places, places, st.booleans())
def test_machine_and_work_coordinates_tell_the_same_place(machine, offset, work):
    track = heard([report("Idle", machine, offset, work, tell=tell) for tell in (True, False, True, False)])
    assert track.standing == pytest.approx(machine, abs=2e-3)


@given(places, places)
def test_work_coordinates_alone_tell_no_place(machine, offset):
    lines = [report("Idle", machine, offset, work=True)] * 5
    assert heard(lines).machine is None
    assert heard([*lines, report("Idle", machine, offset, True, True)] * 2).machine == pytest.approx(machine, abs=2e-3)
    # nor do they after noise: it may have been the report of a new offset; nor after a start
    for noise in (b"<Idle|WPos:0.00", b"Grbl 1.1h ['$' for help]"):
        after = heard(
            [report("Idle", machine, offset, True, True), noise, report("Idle", machine, offset, True), report("Idle", machine, offset, True)]
        )
        assert after.standing is None


@st.composite
def changed(draw, line: bytes) -> bytes:
    """A line that a bad cable has changed: a byte of it lost, another one, or one too many."""
    at = draw(st.integers(0, len(line) - 1))
    byte = draw(st.binary(min_size=1, max_size=1))
    return draw(st.sampled_from([line[:at] + line[at + 1 :], line[:at] + byte + line[at + 1 :], line[:at] + byte + line[at:]]))


@given(places, places, st.booleans(), st.data())
def test_noise_in_every_other_report_never_moves_the_stage(machine, offset, work, data):
    """Whatever it makes of single reports: what is taken for standing was told twice alike, and is true."""
    track = Track()
    for k in range(12):
        line = report("Idle", machine, offset, work, tell=k % 4 < 2)  # noise hits a report that tells the offset, and one that does not
        parts = data.draw(changed(line)).split(b"\n") if k % 2 else [line]
        for part in parts:
            track = follow(track, parse_line(part))
        if track.standing is not None:
            assert track.standing == pytest.approx(machine, abs=2e-3 if work else 1e-9)


@given(st.lists(st.binary(max_size=60), max_size=30), places)
def test_noise_between_reports_is_no_report(noise, machine):
    noise = [n.replace(b"<", b"").replace(b"\n", b"") for n in noise]
    lines = [line for n in noise for line in (n, report("Idle", machine))]
    track = heard([*lines, report("Idle", machine), report("Idle", machine)])
    assert track.standing == machine


@given(places, places)
def test_one_report_is_not_enough_to_stand(first, second):
    track = heard([report("Run", first), report("Idle", second)])
    assert track.standing is None
    assert heard([report("Idle", first), report("Run", first), report("Idle", first)]).standing is None
    assert follow(follow(track, parse_line(report("Idle", second))), Alarm(1)).standing is None
    assert follow(follow(track, parse_line(report("Idle", second))), Welcome("1.1h")).machine is None


# ---- words -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("code", range(100))
def test_every_code_has_words(code):
    for words in (grbl.error_in_words(code), grbl.alarm_in_words(code)):
        assert re.fullmatch(r"(error|alarm)( \d+)?: .+; .+", words)
    assert grbl.error_in_words(0, "Undefined feed rate").startswith("error: Undefined feed rate")


def test_all_codes_of_grbl_are_known():
    assert set(range(1, 18)) | set(range(20, 39)) <= set(grbl.ERRORS)
    assert set(range(1, 10)) <= set(grbl.ALARMS)


@given(st.text(max_size=100))
def test_a_line_with_a_command_in_it_is_not_sent(text):
    try:
        sent = grbl.encode(text)
    except ValueError:
        return
    assert len(sent) <= 80
    assert not set(sent[:-1]) & set(b"?!~\x18\x85\n\r")
    assert sent[:-1].decode() == text


def test_a_track_is_not_changed_by_hearing():
    track = heard([report("Idle", (1, 2, 3))])
    before = replace(track)
    follow(track, Alarm(1))
    assert track == before
