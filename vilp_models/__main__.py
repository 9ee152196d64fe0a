"""`python -m vilp_models`, as `accelerate launch -m` needs it."""

from vilp_models.cli import main

main()
