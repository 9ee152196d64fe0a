"""The page of a dataset: every episode with its frames, facts and findings; nothing from elsewhere; hostile names stay text."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.stored_episodes import VIEWS, episode, write_dataset
from vilp_data.action_sets import recipe_from_dict
from vilp_data.cli import app
from vilp_data.dataset_action_sets import FOLDER, SUFFIX, lock_action_set
from vilp_data.dataset_split import read_split, update_split
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import StoreError, UsageError
from vilp_data.film_strips import FORMS, film_strip, fitting_strip
from vilp_data.measured_fidelity import measured_runs, read_fidelity
from vilp_data.surgery.operations import remove_episodes
from vilp_data.task_toml import task_from_dict
from vilp_data.types import Episode
from vilp_data.viewer.dataset_facts import dataset_facts
from vilp_data.viewer.dataset_page import write_dataset_page

VOID = {"meta", "img", "br", "input", "line", "rect", "polygon", "polyline"}
UNWANTED = {"iframe", "link", "object", "embed", "base", "svg", "video", "a"}
"""Tags that no part of this page needs."""

HOSTILE = "</script><img src=x onerror=alert(1)>\"' & ünï"


class Cards(HTMLParser):
    """The cards of a page: their attributes, their text, their pictures. Every tag is closed, in order."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.sources: list[str] = []
        self.cards: list[dict[str, str]] = []
        self.options: list[tuple[str, str]] = []
        self._depth: int | None = None
        self._option: str | None = None
        self.feed(page)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        of = {name: value or "" for name, value in attrs}
        assert not any(name.startswith("on") for name in of), of
        self.tags.add(tag)
        self.sources += [value for name, value in of.items() if name in ("src", "href", "srcset")]
        if "episode" in of.get("class", "").split():
            self.cards.append({**of, "said": "", "pictures": ""})
            self._depth = len(self.open)
        elif tag == "img" and self._depth is not None:
            self.cards[-1]["pictures"] += of["alt"] + "\n"
        self._option = of.get("value") if tag == "option" else None
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag in VOID:
            return
        assert self.open.pop() == tag
        if self._depth == len(self.open):
            self._depth = None

    def handle_data(self, data: str) -> None:
        if self._option is not None:
            self.options.append((self._option, data))
        if self._depth is not None:
            self.cards[-1]["said"] += data + " "

    def found_by(self, label: str) -> list[str]:
        """What the cards that an option finds say."""
        (number,) = [value for value, told in self.options if told.startswith(label)]
        return [card["said"] for card in self.cards if number in card["data-has"].split()]


def tagged(name: str, n_steps: int, **tags: str) -> Episode:
    return replace(episode(name, n_steps), tags=tags)


def page_of(root: Path, **options: int) -> str:
    path = root.parent / "page.html"
    write_dataset_page(path, dataset_facts(root), **options)
    return path.read_text(encoding="utf-8")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Four episodes of one or two operators, one of them partly masked."""
    made = [tagged("a", 20, operator="anna"), tagged("b", 30, operator="bo"), tagged("c", 24, operator="anna")]
    partly = replace(episode("d", 12, invalid=(0, 1, 2, 3)), tags={"operator": "bo"}, outcome="failure")
    write_dataset(tmp_path / "set", *made, partly)
    return tmp_path / "set"


def measure(root: Path, run: str, psnr_db: float | None, *, frames_of_today: bool = True) -> Path:
    """A report as the fidelity of a run is written, of episode `a`, front view."""
    entry = EpisodeStore(root).entry("a")
    table = {
        "inputs": {"frames": {"a": {"front": entry.frames_id("front") if frames_of_today else "others"}}, "checkpoints": {"front": "x"}},
        "views": {"front": {"episodes": {"a": {"lpips": 0.0125, "vqgan": {"psnr": psnr_db, "moving_psnr": None}}}}},
    }  # fmt: skip
    folder = root / "runs" / run
    (folder / "fidelity").mkdir(parents=True, exist_ok=True)
    (folder / "fidelity" / "report.json").write_text(json.dumps(table))
    return folder


# --- what it shows ------------------------------------------------------------------------------------------------------


def test_every_episode_is_a_card_with_its_side_outcome_length_tags_and_frames_of_every_view(root: Path) -> None:
    page = Cards(page_of(root))
    split = read_split(root)
    assert [card["data-text"].split("\n")[0] for card in page.cards] == ["a", "b", "c", "d"]
    for card, name, seconds in zip(page.cards, "abcd", ("2.0", "3.0", "2.4", "1.2"), strict=True):
        side = {"train": "training", "val": "validation"}[split.assignment[name]]
        assert all(word in card["said"] for word in (name, seconds, side, "operator"))
        assert all(f"{name}, {view} at 0." in card["pictures"] for view in VIEWS)
    assert "failure" in page.cards[3]["said"]
    assert "4  masked" in page.cards[3]["said"]
    assert "33% of its steps are masked" in page.cards[3]["said"]  # a finding in words, not only counted
    assert {source[:22] for source in page.sources} == {"data:image/jpeg;base64"}


def test_choices_find_the_episodes_that_have_them(root: Path) -> None:
    page, train = Cards(page_of(root)), read_split(root).ids("train")
    assert len(page.found_by("training")) == len(train)
    assert [said.split()[0] for said in page.found_by("anna")] != []
    assert len(page.found_by("anna (2)")) == len(page.found_by("bo (2)")) == 2
    assert len(page.found_by("failure (1)")) == 1
    (masked,) = page.found_by("masked steps (1)")
    assert "4  masked" in masked


def test_a_tag_that_is_another_one_in_every_episode_is_sought_by_text_and_no_choice(tmp_path: Path) -> None:
    write_dataset(tmp_path / "set", *(tagged(f"e{n}", 8, seed=f"s{n}", task="one") for n in range(6)))
    page = Cards(page_of(tmp_path / "set"))
    assert not any(told.startswith("s1") for _, told in page.options)
    assert "seed=s1" in page.cards[1]["data-text"]
    assert "s1" in page.cards[1]["said"]


def test_frames_come_from_steps_that_may_be_used(root: Path) -> None:
    store = EpisodeStore(root)
    steps = [frame.step for frame in film_strip(store, store.entry("d"), "front", FORMS[-1])]
    assert steps == [4, 8, 11]


def test_more_episodes_have_fewer_and_smaller_frames_and_stay_within_the_bytes(root: Path) -> None:
    store = EpisodeStore(root)
    entries = store.index()
    rich = len(page_of(root))
    per_form = [
        sum(len(f.uri) for e in entries for v in VIEWS for f in film_strip(store, e, v, form))
        for form in (FORMS[0], FORMS[-1])
    ]
    assert fitting_strip(store, entries) == FORMS[0]
    middling = (per_form[0] + per_form[1]) // 2
    form = fitting_strip(store, entries, page_bytes=middling)
    assert sum(len(f.uri) for e in entries for v in VIEWS for f in film_strip(store, e, v, form)) <= middling
    assert fitting_strip(store, entries, page_bytes=1) == FORMS[-1]
    assert len(page_of(root, page_bytes=1)) < rich - (per_form[0] - per_form[1]) * 0.9


def test_an_episode_whose_frames_are_damaged_keeps_its_card_and_says_so(root: Path) -> None:
    EpisodeStore(root).frames_path("front", "b").write_bytes(b"no shard")
    page = Cards(page_of(root))
    assert len(page.cards) == 4
    assert "view front:" in page.cards[1]["said"]
    assert "1 error" in page.cards[1]["said"]
    assert len(page.found_by("any error (1)")) == 1


def test_a_dataset_without_a_split_or_without_episodes_still_has_a_page(root: Path, tmp_path: Path) -> None:
    (root / "split.lock.json").unlink()
    page = page_of(root)
    assert "none drawn" in page
    assert len(Cards(page).cards) == 4
    store = EpisodeStore(tmp_path / "empty")
    store.write_spec(EpisodeStore(root).spec())
    store.write_index()
    page = page_of(store.root)
    assert "the dataset holds no episode" in page
    assert not Cards(page).cards


def test_an_action_that_is_a_state_some_steps_later_is_told_by_that_state(tmp_path: Path) -> None:
    write_dataset(tmp_path / "set", episode("one", 5), episode("two", 6))
    spec = task_from_dict(
        {
            "name": "test",
            "views": {view: {"topic": f"/{view}", "height": 8, "width": 16} for view in VIEWS},
            "low_dim": {"arm": {"topic": "/joints"}},
            "action": {"target": {"from": "arm", "shift": 1, "kind": "absolute"}},
        },
        where="test",
    )
    EpisodeStore(tmp_path / "set").write_spec(spec)
    assert "target <code>arm</code>" in page_of(tmp_path / "set")


def test_an_action_set_that_cannot_be_read_is_told_and_hides_nothing(root: Path) -> None:
    (root / FOLDER).mkdir()
    (root / FOLDER / f"odd{SUFFIX}").write_text("{")
    page = page_of(root)
    assert re.search(r'<dt>set odd</dt><dd><span class="wrong">[^<]+</span>', page)
    assert len(Cards(page).cards) == 4


def test_a_set_that_does_not_hold_says_what_to_do_and_no_tick_stands_under_it(tmp_path: Path) -> None:
    root = tmp_path / "set"
    write_dataset(root, *(tagged(id, 30, operator="anna") for id in "abcdef"))
    update_split(root, ratio=0.7, ratio_from="task", seed=0, group_by=None, strata=(), redraw=False)
    recipe = recipe_from_dict({"source": {"anna": {"where": {"operator": "anna"}, "count": 2}}}, where="x")
    lock = lock_action_set(root, "small", recipe, given="small")

    def page() -> str:
        """Without the findings in the episodes themselves."""
        write_dataset_page(tmp_path / "page.html", replace(dataset_facts(root), findings={}))
        return (tmp_path / "page.html").read_text(encoding="utf-8")

    assert "nothing to complain about" in page()
    remove_episodes(root, sorted(lock.episodes)[:1])
    assert re.search(
        r'<span class="wrong">[^<]*episodes of it are gone</span> [^<]*<code>vilp-data undo</code>', page()
    )
    assert "nothing to complain about" not in page()


def test_tags_that_make_the_same_groups_are_shown_once(tmp_path: Path) -> None:
    paint = {"gray": "{'colour': 'gray'}", "purple": "{'colour': 'purple'}"}
    colours = ["gray", "purple", "gray", "purple", "gray"]
    write_dataset(
        tmp_path / "set",
        *(
            tagged(f"e{n}", 8, options=paint[c], object=c, **({} if c == "gray" else {"off": "1"}))
            for n, c in enumerate(colours)
        ),
    )  # fmt: skip
    chips = re.findall(r'<span class="chip "[^>]*>([^<]*)</span>', page_of(tmp_path / "set"))
    assert chips == [f"object {colour}" for colour in colours]


# --- reconstruction -----------------------------------------------------------------------------------------------------


def test_measured_episodes_show_their_psnr_and_can_be_ordered_by_it(root: Path) -> None:
    measure(root, "vqgan-x", 31.26)
    page = Cards(page_of(root))
    assert [card.get("data-psnr") for card in page.cards] == ["31.2600", None, None, None]
    assert "31.3 dB PSNR, LPIPS 0.0125" in page.cards[0]["said"]
    assert ("psnr 1", "worst PSNR first") in page.options


def test_numbers_of_frames_that_changed_since_are_not_shown(root: Path) -> None:
    entries = {entry.id: entry for entry in EpisodeStore(root).index()}
    assert not read_fidelity(measure(root, "vqgan-x", 31.26, frames_of_today=False), entries).episodes


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{",
        "\x00",
        '{"views": {"front": []}}',
        '{"views": {"front": {"episodes": {"a": 3}}}}',
        '{"views": {"front": {"episodes": {"a": {"vqgan": {"psnr": NaN}}}}}}',
    ],
)
def test_a_report_of_another_shape_tells_nothing(root: Path, text: str) -> None:
    folder = measure(root, "vqgan-x", None)
    (folder / "fidelity" / "report.json").write_text(text)
    assert not read_fidelity(folder, {entry.id: entry for entry in EpisodeStore(root).index()}).episodes
    assert len(Cards(page_of(root)).cards) == 4


def test_of_several_runs_the_one_named_is_shown(root: Path) -> None:
    one, two = measure(root, "vqgan-one", 30.0), measure(root, "vqgan-two", 35.0)
    assert set(measured_runs(root)) == {one, two}
    for run, psnr_db in ((one, 30.0), (two, 35.0)):
        assert dataset_facts(root, run=run).least_psnr_db("a") == psnr_db


# --- hostile names, scripts ---------------------------------------------------------------------------------------------


def test_names_tags_and_findings_that_look_like_html_stay_text(tmp_path: Path) -> None:
    root = tmp_path / "<b>set&"
    hostile = replace(episode("one", 8), tags={HOSTILE: HOSTILE}, findings=(HOSTILE,))
    write_dataset(
        root, hostile, tagged("<i>two", 9, **{HOSTILE: "x"}), episode("&amp;three", 10), episode("four' onload='x", 11)
    )
    text = page_of(root)
    page = Cards(text)  # no attribute that begins with "on", every tag closed
    assert not page.tags & UNWANTED
    assert text.count("</script>") == text.count("<script") == 1
    assert "<img src=x" not in text
    assert "<i>two" not in text
    assert {source[:5] for source in page.sources} == {"data:"}
    assert sum(HOSTILE in card["said"] for card in page.cards) == 2
    assert "&amp;three" in "".join(card["said"] for card in page.cards)


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
def test_the_script_is_javascript(root: Path, tmp_path: Path) -> None:
    script = re.search(r"<script>(.*?)</script>", page_of(root), re.DOTALL)
    assert script
    (tmp_path / "page.js").write_text(script[1])
    assert subprocess.run(["node", "--check", tmp_path / "page.js"], capture_output=True, check=False).returncode == 0


def test_nothing_is_left_where_the_page_cannot_be_written(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    facts = dataset_facts(root)

    def failing(*_: object, **__: object) -> str:
        raise StoreError("the disk is full")

    monkeypatch.setattr("vilp_data.viewer.dataset_page.card", failing)
    with pytest.raises(StoreError):
        write_dataset_page(root / "page.html", facts)
    assert not list(root.glob("*page*"))


# --- the command --------------------------------------------------------------------------------------------------------


def view(*arguments: object) -> tuple[Exception | None, str]:
    result = CliRunner().invoke(app, ["view", *map(str, arguments)])
    error = result.exception
    return (error if isinstance(error, Exception) else None), result.stdout


def test_a_dataset_folder_with_html_writes_its_page(root: Path, tmp_path: Path) -> None:
    error, said = view(root, "--html", tmp_path / "out.html")
    assert error is None
    assert "4 episodes" in said
    assert len(Cards((tmp_path / "out.html").read_text()).cards) == 4


def test_without_a_target_html_shows_the_dataset_that_is_named(root: Path, tmp_path: Path) -> None:
    assert view("--data", root, "--html", tmp_path / "out.html")[0] is None
    assert (tmp_path / "out.html").is_file()


@pytest.mark.parametrize("options", [[], ["--save", "x.rrd"], ["--html", "p.html", "--screenshot", "x.png"]])
def test_a_dataset_without_html_is_told_what_can_be_done(root: Path, options: list[str], tmp_path: Path) -> None:
    error, _ = view(root, *options)
    assert isinstance(error, UsageError)
    assert f"vilp-data view {root} --html" in str(error)
    assert f"--data {root}" in str(error)
    assert not Path("p.html").exists()


def test_a_run_that_is_not_there_is_refused(root: Path, tmp_path: Path) -> None:
    error, _ = view(root, "--html", tmp_path / "out.html", "--run", root / "runs" / "none")
    assert isinstance(error, UsageError)
    assert not (tmp_path / "out.html").exists()


def test_html_of_a_log_or_an_episode_is_refused(root: Path, tmp_path: Path) -> None:
    error, _ = view("a", "--data", root, "--html", tmp_path / "out.html")
    assert isinstance(error, UsageError)
    assert "--generated" in str(error)


def test_a_page_that_cannot_be_written_there_is_refused_before_the_dataset_is_checked(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vilp_data.viewer.dataset_facts.dataset_facts", lambda *_, **__: pytest.fail("checked"))
    assert isinstance(view(root, "--html", root)[0], UsageError)
