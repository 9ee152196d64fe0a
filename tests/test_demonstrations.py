"""Where a log is cut: nothing is lost between gaps, markers mean what the task says, ranges files say what is wrong with them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vilp_data.demonstrations import (
    CUT_TAG,
    LOG_TAG,
    Marker,
    Span,
    named,
    spans_between_gaps,
    spans_by_value,
    spans_of_rows,
)
from vilp_data.episodes_spec import EpisodesSpec, read_ranges
from vilp_data.errors import SpecError
from vilp_data.task_toml import parse_task
from vilp_data.types import LogEpisode

S = 10**9
WHOLE = LogEpisode("whole", 0, 100 * S + 1, {"operator": "kim"})


@given(times=st.lists(st.integers(0, 10**12), max_size=60), gap_s=st.floats(0.001, 50))
def test_every_message_lies_in_one_span_and_no_span_holds_a_longer_gap(times: list[int], gap_s: float) -> None:
    spans = spans_between_gaps(np.array(times, np.int64), gap_s)
    for time in times:
        assert sum(span.start_ns <= time < span.end_ns for span in spans) == 1
    for span in spans:
        inside = np.sort([time for time in times if span.start_ns <= time < span.end_ns])
        assert (np.diff(inside) <= gap_s * S).all()
        assert (inside[0], inside[-1]) == (span.start_ns, span.end_ns - 1)
    for one, two in pairwise(spans):
        assert two.start_ns - (one.end_ns - 1) > gap_s * S


def cut(values: list[object], **rule: object) -> list[tuple[int, int, dict[str, str]]]:
    """Spans in seconds of markers sent at 0 s, 1 s, 2 s, …, in a log that ends at 100 s."""
    spec = EpisodesSpec(by="topic", topic="/m", **rule)  # type: ignore[arg-type]
    markers = [Marker(second * S, value) for second, value in enumerate(values) if value is not None]
    spans = spans_by_value(markers, spec, start_ns=-S, end_ns=100 * S)
    return [(span.start_ns // S, span.end_ns // S, span.tags) for span in spans]


def test_a_demonstration_lasts_while_the_value_is_true() -> None:
    assert cut([False, True, True, False, True]) == [(1, 3, {}), (4, 100, {})]
    assert cut([0, 2, 3, 0.0, float("nan")]) == [(1, 3, {})]
    assert cut(["idle", "Grasp", "", "false", "go"]) == [(1, 2, {}), (4, 100, {})]


def test_with_a_tag_every_value_is_a_demonstration_of_its_own() -> None:
    assert cut([1, 1, 2, 0, 2], tag="object") == [
        (0, 2, {"object": "1"}),
        (2, 3, {"object": "2"}),
        (4, 100, {"object": "2"}),
    ]


def test_between_start_and_stop_values() -> None:
    assert cut(["x", "go", "x", "halt", "x", "go"], start="go", stop="halt") == [(1, 3, {}), (5, 100, {})]
    assert cut(["go", "x", "go", "halt", "halt"], start="go", stop="halt") == [(0, 2, {}), (2, 3, {})]
    assert cut([0, 7, 0, 9], start=7, stop=0) == [(1, 2, {})]


def test_one_of_start_and_stop_alone_divides_the_log() -> None:
    assert cut([None, None, 1, 0, 1], start=1) == [(2, 4, {}), (4, 100, {})]
    assert cut([None, None, 1, 0, 1], stop=1) == [(-1, 2, {}), (2, 4, {})]


def test_a_topic_may_start_and_another_stop() -> None:
    spec = EpisodesSpec(by="topic", topic="/start", stop_topic="/stop")
    markers = [
        Marker(1 * S, True),
        Marker(5 * S, True, stops=True),
        Marker(6 * S, True, stops=True),
        Marker(8 * S, True),
    ]
    spans = spans_by_value(markers, spec, start_ns=0, end_ns=9 * S)
    assert [(span.start_ns // S, span.end_ns // S) for span in spans] == [(1, 5), (8, 9)]


@given(values=st.lists(st.sampled_from([0, 1, 2, "go", "", True]), max_size=20), tag=st.sampled_from([None, "object"]))
def test_spans_by_value_never_overlap_and_hold_true_values_only(values: list[object], tag: str | None) -> None:
    spans = cut(values, tag=tag)
    for one, two in pairwise(spans):
        assert one[1] <= two[0]
    for second, value in enumerate(values):
        assert any(start <= second < end for start, end, _ in spans) == bool(value)


# --- ranges -----------------------------------------------------------------------------------------------------------------


def test_ranges_are_seconds_from_the_start_or_absolute_nanoseconds() -> None:
    text = "start, end, name, success, object\n1.5, 4, first, yes, cup\n10,20,,no,\n"
    one, two = spans_of_rows(read_ranges(text, where="r.csv"), "run.mcap", start_ns=7 * S)
    assert one == Span(
        8_500_000_000, 11 * S, {"object": "cup", "success": "true", CUT_TAG: "1.5-4 s"}, "first", 8_500_000_000
    )
    assert two == Span(17 * S, 27 * S, {"success": "false", CUT_TAG: "10-20 s"}, None, 17 * S)
    absolute = "start_ns,end_ns\n1700000000000000000,1700000001000000000\n"
    (span,) = spans_of_rows(read_ranges(absolute, where="r.csv"), "run.mcap", start_ns=7 * S)
    assert (span.start_ns, span.end_ns) == (1700000000 * S, 1700000001 * S)
    assert spans_of_rows(read_ranges(absolute.replace("_ns", ""), where="r.csv"), "run.mcap", start_ns=7 * S) == [span]


def test_a_ranges_file_may_be_of_many_logs() -> None:
    rows = read_ranges("log,start,end\nmonday.mcap,0,1\ntuesday,1,2\n,3,4\n", where="r.csv")
    starts = {
        log: [span.start_ns // S for span in spans_of_rows(rows, log, start_ns=0)]
        for log in ("monday.mcap", "tuesday.bag")
    }
    assert starts == {"monday.mcap": [0, 3], "tuesday.bag": [1, 3]}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "needs a header line"), ("begin,end\n1,2\n", "columns start and end"), ("start,end\n", "without ranges"),
        ("start,end\n1,x\n", "r.csv, line 2: end is no number"), ("start,end\n0,1\n5,5\n", "line 3: a range must end after it starts"),
        ("start,end\n0,nan\n", "end is no number"), ("start,end\nnan,1\n", "start is no number"),
        ("start,end\n0,inf\n", "end is no number"), ("start,end\n0,1e999\n", "end is no number"),
        (f"start_ns,end_ns\n0,{10**30}\n", "end_ns is no number"),
        (f"start,end\n5,{17 * 10**17}\n", "not of one kind"), ("start,end\n0,1e16\n", "not of one kind"),
        ("start,end,success\n1,2,maybe\n", "success is true or false"), ("start_ns,end_ns\n1.5,2\n", "whole nanoseconds"),
    ],
)  # fmt: skip
def test_a_ranges_file_that_cannot_be_used_names_its_line(text: str, said: str) -> None:
    with pytest.raises(SpecError, match=said):
        read_ranges(text, where="r.csv")


# --- names -----------------------------------------------------------------------------------------------------------------


def test_a_cut_is_named_after_its_start_and_keeps_the_log_s_tags() -> None:
    spans = [Span(50 * S, 60 * S, {"object": "cup"}), Span(12_345_678_901, 20 * S, {}, "mine")]
    one, two = named(spans, WHOLE, log="run.mcap", start_ns=0, alone=True)
    assert (one.name, two.name) == ("mine", "at-00050.000s")
    assert two.tags == {"operator": "kim", LOG_TAG: "run", "object": "cup"}
    assert (two.start_ns, two.end_ns) == (50 * S, 60 * S)


def test_one_more_cut_renames_no_other() -> None:
    spans = [Span(50 * S, 60 * S), Span(70 * S, 80 * S)]
    before = [found.name for found in named(spans, WHOLE, log="run.mcap", start_ns=0, alone=True)]
    after = [found.name for found in named([*spans, Span(0, S)], WHOLE, log="run.mcap", start_ns=0, alone=True)]
    assert after[1:] == before


def test_cuts_that_begin_in_one_millisecond_have_names_of_their_own_and_the_first_keeps_its() -> None:
    starts = [1_500_000_000, 1_500_200_000, 1_500_200_001, 1_501_000_000]
    names = [
        found.name for found in named([Span(t, 9 * S) for t in starts], WHOLE, log="run.mcap", start_ns=0, alone=True)
    ]
    assert names == ["at-00001.500s", "at-00001.500200s", "at-00001.500200001s", "at-00001.501s"]


def test_two_ranges_of_one_name_are_refused() -> None:
    with pytest.raises(SpecError, match="two ranges are called 'a'"):
        named([Span(0, S, {}, "a"), Span(2 * S, 3 * S, {}, "a")], WHOLE, log="run.mcap", start_ns=0, alone=True)


# --- the table ----------------------------------------------------------------------------------------------------------------

TASK = 'name = "x"\n[views.front]\ntopic = "/a"\nheight = 8\nwidth = 8\n[episodes]\n'


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ('by = "gaps"', 'it is "file", "gap", "topic"'), ('by = "gap"', "needs gap_s"), ('by = "topic"', "needs `topic`"),
        ('by = "gap"\ngap_s = 1.0\ntag = "x"', "`tag` says nothing where by = 'gap'"), ('gap_s = 1.0', "says nothing where by = 'file'"),
        ('by = "topic"\ntopic = "/m"\nstart = 1\ntag = "x"', "leave `start` and `stop` out"),
        ('by = "gap"\ngap = 1', "did you mean 'gap_s'"),
        ('by = "topic"\ntopic = "/m"\nstop_topic = "/n"\nstop = 1', "leave `stop` and `tag` out"),
    ],
)  # fmt: skip
def test_a_table_that_contradicts_itself_is_refused(table: str, said: str) -> None:
    with pytest.raises(SpecError) as refused:
        parse_task(TASK + table, where="task.toml")
    assert said in str(refused.value)


def test_only_tasks_that_cut_have_it_in_their_ingest_fields() -> None:
    def fields(table: str) -> dict[str, object]:
        return parse_task(TASK + table, where="task.toml").ingest_fields()

    assert "episodes" not in fields("")
    assert "episodes" not in fields('by = "file"')
    assert fields('by = "gap"\ngap_s = 2')["episodes"] == {"by": "gap", "gap_s": 2.0}
    assert fields('by = "topic"\ntopic = "/m"\nstart = 0\nstop = false')["episodes"] == {
        "by": "topic", "topic": "/m", "start": 0, "stop": False,
    }  # fmt: skip
    assert fields('by = "a.csv"') == fields('by = "b.csv"')
