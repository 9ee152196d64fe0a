"""The low-level policy: two frames Δt steps apart to the actions between them (paper, "Low-level policy").

It learns from recorded pairs and acts on imagined ones. Shape suffixes: B batch, H and W image pixels, c h w latent channels and
pixels, F features, K codes, A action; Δt is the contract's frame_stride.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vilp_data.errors import UsageError
from vilp_data.pairs import PairTensors
from vilp_models.contract import DataContract, Moments
from vilp_models.normaliser import Normaliser
from vilp_models.recipe import PolicyRecipe
from vilp_models.vision import ResNet18
from vilp_models.vqgan import nearest_codes, to_signed

Reconstruct = Callable[[str, Tensor], Tensor]
"""View and latents [B,c,h,w] before quantisation to the images uint8 [B,H,W,3] that the VQGAN makes of them."""

Images = Mapping[str, Tensor]
"""view -> uint8 [B,H,W,3], or for a policy that sees latents view -> float [B,c,h,w]."""


class LowLevelPolicy(nn.Module):
    """A ResNet-18 for each view, and one MLP over what all of them make of both frames.

    Mean squared error of actions in units of their deviation is what is minimised. A policy that sees latents quantises what
    it is given, whoever gives it, so that it sees the same codes in training and in use; quantised latents stay as they are.
    """

    def __init__(
        self,
        recipe: PolicyRecipe,
        contract: DataContract,
        *,
        codebooks: Mapping[str, Tensor] | None = None,
        reconstruct: Reconstruct | None = None,
    ) -> None:
        """`codebooks` (view -> float [K,c]) are for training a policy that sees latents; a checkpoint brings its own.
        `reconstruct` is for training with a share of reconstructed frames.

        Raises UsageError where the contract lacks the latents that the recipe needs."""
        super().__init__()
        self.recipe, self.views = recipe, contract.views
        self.frame_stride, self.action_size = contract.frame_stride, contract.action_size
        self._reconstruct = reconstruct
        latents = recipe.sees == "latents"
        if latents or recipe.reconstructed_share:
            _require_latents(recipe, contract)
        self.seen = nn.ModuleDict()
        for view in self.views if latents else ():
            codes, moments = (codebooks or {}).get(view), contract.normaliser[f"latents/{view}"]
            self.seen[view] = QuantisedLatents(contract.latent_shapes[view][0], codes, moments)

        def eyes() -> dict[str, ResNet18]:
            sizes = contract.latent_shapes
            channels = {v: sizes[v][0] if latents else contract.image_channels(v) for v in self.views}
            return {v: ResNet18(recipe.vision_width, n, recipe.pool, latents=latents) for v, n in channels.items()}

        nets = eyes()
        self.vision = nn.ModuleDict(nets)
        self.second_vision = None if recipe.shared_vision else nn.ModuleDict(eyes())
        features = 2 * sum(net.features for net in nets.values())
        self.low_dim = None
        if recipe.low_dim and contract.low_dim_size:
            self.low_dim = Normaliser(contract.normaliser["low_dim"])
            features += contract.low_dim_size
        self.head = mlp(features, recipe.hidden, self.frame_stride * self.action_size)
        self.action = Normaliser(contract.normaliser["action"])

    # --- training

    def losses(self, batch: PairTensors, generator: torch.Generator) -> dict[str, Tensor]:
        """{"action": mean squared error in units of the actions' deviations}. In training mode the seed of `generator` decides which
        pairs get a reconstructed second frame."""
        seen = batch.latents if self.recipe.sees == "latents" else batch.frames
        first = {view: seen[view][:, 0] for view in self.views}
        second: Images = {view: seen[view][:, 1] for view in self.views}
        if self.training and self.recipe.reconstructed_share:
            second = self._partly_reconstructed(second, batch.latents, generator)
        predicted = self(first, second, batch.low_dim)
        return {"action": F.mse_loss(predicted, self.action.normalised(batch.action))}

    def _partly_reconstructed(self, second: Images, latents: Images, generator: torch.Generator) -> Images:
        if self._reconstruct is None:
            raise UsageError(
                "reconstructed_share needs the VQGAN",
                found=f"models.policy.reconstructed_share = {self.recipe.reconstructed_share} and nothing that decodes",
                remedy="give `reconstruct` to the policy, or set the share to 0",
            )
        frames = next(iter(second.values()))
        count = round(self.recipe.reconstructed_share * len(frames))
        mixed = {view: images.clone() for view, images in second.items()}
        if count:
            chosen = _drawn_rows(len(frames), count, generator.initial_seed(), frames.device)
            for view, images in mixed.items():
                decoded = self._reconstruct(view, latents[view][:, 1].index_select(0, chosen))
                images.index_copy_(0, chosen, decoded)
        return mixed

    # --- use

    @torch.no_grad()
    def act(self, first: Images, second: Images, low_dim: Tensor | None = None) -> Tensor:
        """The actions from the first frame to the second, float32 [B,Δt,A] in the dataset's unit. low_dim float32 [B,L] is that of
        the first frame; only a policy that was trained with it looks at it."""
        return self.action.restored(self(first, second, low_dim))

    def forward(self, first: Images, second: Images, low_dim: Tensor | None) -> Tensor:
        """Normalised actions, float32 [B,Δt,A]."""
        features = [self._features(view, first[view], second[view]) for view in self.views]
        if self.low_dim is not None:
            features.append(self.low_dim.normalised(_given(low_dim)))
        # In float32 even where the convolutions run in bf16: eight bits of mantissa would round targets by half a pixel.
        with torch.autocast(features[0].device.type, enabled=False):
            actions: Tensor = self.head(torch.cat([part.float() for part in features], dim=1))
        return actions.view(-1, self.frame_stride, self.action_size)

    def _features(self, view: str, first: Tensor, second: Tensor) -> Tensor:
        if self.second_vision is not None:
            each = [self.vision[view](self._seen(view, first)), self.second_vision[view](self._seen(view, second))]
            return torch.cat(each, dim=1)
        both: Tensor = self.vision[view](self._seen(view, torch.cat([first, second])))
        return torch.cat(both.chunk(2), dim=1)

    def _seen(self, view: str, images: Tensor) -> Tensor:
        if self.recipe.sees == "frames":
            return to_signed(images)
        quantised: Tensor = self.seen[view](images)
        return quantised


class QuantisedLatents(nn.Module):
    """One view's latents float [B,c,h,w] to the codes nearest to them, float32 [B,c,h,w], standardised."""

    codes: Tensor

    def __init__(self, channels: int, codes: Tensor | None, moments: Moments) -> None:
        """`codes` float [K,c] are those of the view's VQGAN; None leaves them to `load_state_dict`."""
        super().__init__()
        self.register_buffer("codes", torch.empty(0, channels) if codes is None else codes.detach().float().clone())
        self.standard = Normaliser(moments, axis=-3)

    def forward(self, z_BCHW: Tensor) -> Tensor:
        if not len(self.codes):
            raise UsageError(
                "a policy that sees latents needs the VQGAN's codebooks",
                remedy="give `codebooks` to the policy, or load a trained one",
            )
        quantised = self.codes[nearest_codes(z_BCHW, self.codes)]
        return self.standard.normalised(quantised.permute(0, 3, 1, 2))

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *rest: Any) -> None:
        stored = state_dict.get(f"{prefix}codes")
        if stored is not None:
            self.codes = self.codes.new_empty(stored.shape)
        super()._load_from_state_dict(state_dict, prefix, *rest)


def mlp(in_features: int, hidden: Sequence[int], out_features: int) -> nn.Sequential:
    """Linear layers of these widths with ReLU between them."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(in_features, width), nn.ReLU()]
        in_features = width
    return nn.Sequential(*layers, nn.Linear(in_features, out_features))


def _drawn_rows(size: int, count: int, seed: int, device: torch.device) -> Tensor:
    """`count` of the numbers below `size`, int64 on `device`. Drawn in main memory, and so many whatever is drawn: nothing waits
    for the device."""
    rows = torch.randperm(size, generator=torch.Generator().manual_seed(seed))[:count]
    return rows.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else rows.to(device)


def _given(low_dim: Tensor | None) -> Tensor:
    if low_dim is None:
        raise UsageError("this policy was trained with low_dim", remedy="give it the low_dim of the first frame")
    return low_dim.float()


def _require_latents(recipe: PolicyRecipe, contract: DataContract) -> None:
    missing = [view for view in contract.views if view not in contract.latent_shapes]
    if missing:
        why = 'sees = "latents"' if recipe.sees == "latents" else "reconstructed_share"
        raise UsageError(
            f"models.policy.{why} needs latents of every view",
            found=f"none of {', '.join(missing)}",
            remedy="train a VQGAN and run `vilp-data latents`",
        )
