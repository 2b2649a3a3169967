"""Many rollouts at once, by the number of rollouts and of devices."""
