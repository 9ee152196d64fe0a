"""`source_digest`: what counts as the code that made an episode."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path

import pytest

from vilp_data.sims.source_digest import source_digest

FILES = {
    "own_sim/__init__.py": 'entry_point = "own_sim.world:World"\n',
    "own_sim/world.py": 'import numpy\nfrom own_sim.physics import G\n\ndef fall():\n    """Down."""\n    return G\n',
    "own_sim/physics.py": "G = 9.81\n",
    "own_sim/other.py": "A = 1\n",
    "own_sim/expert.py": "from . import physics\n",
}

Change = Callable[[str, str], str]


@pytest.fixture
def changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Change:
    """The digest of a small package once a file of it has another text."""
    (tmp_path / "own_sim").mkdir()
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))

    def change(name: str, text: str) -> str:
        (tmp_path / name).write_text(text)
        importlib.invalidate_caches()
        return source_digest(["own_sim", "own_sim.expert"])

    return change


def test_what_the_modules_do_counts_and_what_they_import_beside_them(changed: Change) -> None:
    first = changed("own_sim/other.py", FILES["own_sim/other.py"])
    for name in ("own_sim/world.py", "own_sim/physics.py", "own_sim/expert.py"):
        assert changed(name, FILES[name] + "B = 2\n") != first
        assert changed(name, FILES[name]) == first


def test_words_layout_and_modules_that_nobody_imports_do_not_count(changed: Change) -> None:
    first = changed("own_sim/other.py", "A = 2\n")
    assert changed("own_sim/world.py", FILES["own_sim/world.py"].replace("Down", "To the ground")) == first
    assert changed("own_sim/physics.py", "# m/s^2\n\nG  =  9.81\n") == first


def test_a_module_that_is_not_there_or_no_python_counts_by_its_name(changed: Change) -> None:
    assert source_digest(["no_such_package.module"]) != source_digest(["no_such_package.other"])
    broken = changed("own_sim/physics.py", "G = = 9.81\n")
    assert broken == changed("own_sim/physics.py", "G = = 9\n")
