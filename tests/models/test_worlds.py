"""Which environment an episode belongs to: the task's own, or that of one of its variants."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from tests.models.toy_simulator import Dot
from tests.stored_episodes import episode, write_dataset
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.spec import TaskSpec
from vilp_data.task_toml import load_task, parse_task
from vilp_models import simulator
from vilp_models.simulator import Worlds, is_of_world, world_tags
from vilp_models.starts import episode_starts

WORLD = {"goal": "row", "object": "gray_blocks"}


def test_an_episode_is_of_a_world_unless_one_of_its_tags_says_another() -> None:
    assert is_of_world({"goal": "row", "object": "gray_blocks", "seed": "3"}, WORLD)
    assert is_of_world({"operator": "me"}, WORLD)  # recorded before there were such tags, or by people
    assert is_of_world({"goal": "column"}, {})  # an environment that says nothing of itself
    assert not is_of_world({"goal": "row", "object": "purple_blocks"}, WORLD)
    assert not is_of_world({"goal": "row", "object": "gray_blocks", "variant": "small"}, WORLD)


@pytest.mark.sim
def test_each_episode_gets_the_environment_whose_tags_it_has_and_the_tasks_own_where_none_has() -> None:
    pytest.importorskip("gym_pusht", reason="the simulators are not installed: make setup")
    worlds = Worlds(load_task("pusht"), cameras=False)
    own, moved = worlds.of({"goal": "256,256,45"}), worlds.of({"goal": "356,356,45", "object": "T"})
    assert (world_tags(own)["goal"], world_tags(moved)["goal"]) == ("256,256,45", "356,356,45")
    assert worlds.of({}) is own
    assert worlds.of({"goal": "1,2,3"}) is own
    assert worlds.of({"goal": "356,356,45"}) is moved  # made once
    assert worlds.own_tags() == {"goal": "256,256,45", "object": "T"}
    worlds.close()


def test_the_variant_that_an_episode_names_decides_before_its_other_tags(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulator, "make_env", lambda spec, cameras: Alike(spec.sim.options.get("n_cups", 3)))
    numbers = "episodes = 1\noptions = { n_cups = 2 }\n"
    text = (
        'name = "cups"\n[views.top]\ntopic = "/top"\nheight = 8\nwidth = 8\n[sim]\nenv = "test/Cups-v0"\n'
        f"[record.variants.two_cups]\nfirst_seed = 5000\n{numbers}"
    )
    worlds = Worlds(parse_task(text, where="test"), cameras=False)
    tags = {"goal": "board", "object": "cups"}
    assert worlds.of(tags).n_cups == 3
    assert worlds.of({**tags, "variant": "two_cups"}).n_cups == 2
    assert worlds.of({**tags, "variant": "no_more"}).n_cups == 3


class Alike:
    """Says the same of itself however many cups it has."""

    def __init__(self, n_cups: int) -> None:
        self.n_cups = n_cups

    @property
    def unwrapped(self) -> Alike:
        return self

    def tags(self) -> dict[str, str]:
        return {"goal": "board", "object": "cups"}


def simulated(env: str) -> TaskSpec:
    return parse_task(
        f'name = "own"\n[views.top]\ntopic = "/top"\nheight = 8\nwidth = 12\n[sim]\nenv = "{env}"\n', where="test"
    )


def test_a_limit_that_was_registered_with_gymnasium_does_not_end_an_episode() -> None:
    gymnasium.register("test/Limited-v0", entry_point=Dot, max_episode_steps=3)
    env = simulator.make_env(simulated("test/Limited-v0"))
    env.reset(seed=0)
    assert not any(env.step(np.zeros(1, np.float32))[3] for _ in range(5))
    gymnasium.registry.pop("test/Limited-v0")


@pytest.mark.parametrize(
    ("env", "says"),
    [
        ("reach dot v0", "cannot be made(.|\n)*gymnasium id"),
        ("test/Nobody-v0", "cannot be made(.|\n)*gymnasium id"),
        ("no_such_module:mine/ReachDot-v0", "cannot be made(.|\n)*PYTHONPATH"),
    ],
)
def test_a_simulator_that_is_not_there_is_said_to_be_missing(env: str, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        simulator.make_env(simulated(env))


def test_episodes_of_other_worlds_are_no_starts(tmp_path: Path) -> None:
    tagged = [
        replace(episode(name, 6), tags={"object": colour}, state=np.zeros((6, 2)))
        for name, colour in (("a", "gray_blocks"), ("b", "purple_blocks"), ("c", "gray_blocks"))
    ]
    write_dataset(tmp_path, *tagged)
    store = EpisodeStore(tmp_path)
    assert [start.name for start in episode_starts(store, "all")[0]] == ["a", "b", "c"]
    starts, recordings = episode_starts(store, "all", world=WORLD)
    assert [start.name for start in starts] == ["a", "c"]
    assert set(recordings) == {start.policy_seed for start in starts}
    assert [start.name for start in episode_starts(store, "all", world=WORLD, limit=2)[0]] == ["a", "c"]
    with pytest.raises(UsageError, match="green_blocks"):
        episode_starts(store, "all", world={"object": "green_blocks"})
