"""`vilp-models`, also as `python -m vilp_models`, as `accelerate launch -m` needs it."""

from vilp_data.__main__ import main as start


def main() -> None:
    start("vilp-models", "vilp_models.cli")


if __name__ == "__main__":
    main()
