"""A plan of VILP, part by part, against the same plan done plainly: every frame decoded, and attention to the context in full at
every denoising step; then with a low-level policy that reads latents, which needs no decoder at all.

The networks are the paper's sizes with random weights (what they compute takes as long), one observation at a time.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections import Counter
from collections.abc import Mapping

import numpy as np
import torch

from vilp_models.contract import DataContract
from vilp_models.low_level import LowLevelPolicy
from vilp_models.planner import Condition, Planner
from vilp_models.policies.base import Observation
from vilp_models.policies.vilp import VilpPolicy
from vilp_models.recipe import PlannerRecipe, PolicyRecipe, VqganRecipe
from vilp_models.trained import default_device
from vilp_models.unet3d import OneTokenAttention
from vilp_models.vqgan import VqganEncoder, build_vqgan

VIEW = "top"
LATENT_CHANNELS = 3


class PlainPlanner(Planner):
    """The same function without the shortcut: the context is attended to, by queries, at every step."""

    def predict(self, x_BCThw, level_B, condition):
        projected = self.unet.project(self.plain_context)  # keys and values anew for each step
        return super().predict(x_BCThw, level_B, type(condition)(projected, condition.beside, condition.present))

    def condition(self, frames, present_latents, low_dim):
        self.plain_context = self.context(frames, low_dim)
        return Condition([], None, None)


def plain(planner: Planner) -> Planner:
    """A copy of the planner that shares nothing and cuts no corner."""
    other = copy.deepcopy(planner)
    other.__class__ = PlainPlanner
    for module in list(other.modules()):
        for name, child in module.named_children():
            if isinstance(child, OneTokenAttention):
                setattr(module, name, child.as_full())
    return other.eval()


def contract(height: int, width: int, n_plan_frames: int) -> DataContract:
    ones = {"mean": [0.0] * LATENT_CHANNELS, "std": [1.0] * LATENT_CHANNELS}
    return DataContract(
        task="bench", views=(VIEW,), geometry={VIEW: (height, width, "")}, rate_hz=10.0, frame_stride=2,
        n_plan_frames=n_plan_frames, latent_keys={VIEW: "random"},
        latent_shapes={VIEW: (LATENT_CHANNELS, height // 8, width // 8)}, action_size=2,
        normaliser={f"latents/{VIEW}": ones, "action": {"mean": [0.0] * 2, "std": [1.0] * 2}},
    )  # fmt: skip


def timed(policy: VilpPolicy, observation: Observation, *, plans: int) -> tuple[float, Mapping[str, float]]:
    """(seconds a plan, seconds of each part), the median of `plans` after one that does not count."""
    policy.reset(0)
    policy.act(observation)
    totals, parts = [], []
    for _ in range(plans):
        started = time.perf_counter()
        policy.act(observation)
        totals.append(time.perf_counter() - started)
        parts.append(Counter(policy.timings()))
    middle = int(np.argsort(totals)[len(totals) // 2])
    return totals[middle], parts[middle]


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--plans", type=int, default=3)
    arguments.add_argument("--width", type=int, default=64, help="of the planner; the paper's 64 (Can) or 128 (Push-T)")
    given = arguments.parse_args()
    device = default_device()
    print(
        f"torch {torch.__version__}, {torch.get_num_threads()} threads, {device}; planner width {given.width}, VQGAN width 128"
    )
    for height, width, n_frames, n_actions in ((96, 96, 12, 16), (96, 160, 6, 8), (96, 160, 6, 4)):
        torch.manual_seed(0)
        made_for = contract(height, width, n_frames)
        planner = Planner(PlannerRecipe(width=given.width, low_dim=False), made_for, VIEW).to(device)
        for parameter in planner.parameters():  # layers that begin at zero would make both plans equal whatever they do
            if not parameter.any():
                torch.nn.init.normal_(parameter, std=0.02)
        model = build_vqgan(VqganRecipe())
        torch.nn.init.normal_(
            model.quantize.embedding.weight
        )  # as far apart as latents are, or all would be near a tie
        encoder = VqganEncoder(model, device=device)
        frames = torch.randint(0, 256, (1, height, width, 3), dtype=torch.uint8).numpy()
        observation = Observation({VIEW: frames}, np.zeros((1, 0), np.float32), np.zeros((1, 2), np.float32))
        from_frames = LowLevelPolicy(PolicyRecipe(), made_for).to(device)
        codebooks = {VIEW: model.quantize.embedding.weight}
        from_latents = LowLevelPolicy(PolicyRecipe(sees="latents"), made_for, codebooks=codebooks).to(device)
        policies = {
            "plainly": VilpPolicy(
                {VIEW: plain(planner)}, {VIEW: encoder}, from_frames, n_action_steps=n_actions, decode_all=True
            ),
            "VILP": VilpPolicy({VIEW: planner}, {VIEW: encoder}, from_frames, n_action_steps=n_actions),
            "VILP, reading latents": VilpPolicy(
                {VIEW: planner}, {VIEW: encoder}, from_latents, n_action_steps=n_actions
            ),
        }
        difference = same_output(policies["plainly"], policies["VILP"], observation)
        print(f"\n{height}x{width}, {n_frames} frames, {n_actions} actions, 4 denoising steps; VILP's actions differ from the "
              f"plain ones by {difference:.1e}")  # fmt: skip
        base = None
        for name, policy in policies.items():
            seconds, parts = timed(policy, observation, plans=given.plans)
            base = base or seconds
            told = ", ".join(f"{part} {spent * 1e3:.0f}" for part, spent in parts.items())
            print(f"  {name:<22}{seconds * 1e3:7.0f} ms a plan   {base / seconds:5.2f}x   ({told})")


def same_output(one: VilpPolicy, other: VilpPolicy, observation: Observation) -> float:
    """Largest difference between what both do."""
    actions = []
    for policy in (one, other):
        policy.reset(0)
        actions.append(policy.act(observation))
    return float(np.abs(actions[0] - actions[1]).max())


if __name__ == "__main__":
    main()
