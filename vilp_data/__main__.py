"""`vilp-data`, also as `python -m vilp_data`: so little that Ctrl-C is answered in words from the first moment on."""

import sys
from importlib import import_module


def main(name: str = "vilp-data", commands: str = "vilp_data.cli") -> None:
    """Run the command line in module `commands`."""
    try:
        run = import_module(commands).main
    except KeyboardInterrupt:
        print(f"{name}: stopped before it began", file=sys.stderr)
        sys.exit(130)
    run()


if __name__ == "__main__":
    main()
