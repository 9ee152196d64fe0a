"""What acts in an environment: one file a policy, all of them `base.Policy`."""
