"""SafeSwitch baselines: learners, signals and switch rules. They import `safeswitch`, never the reverse."""
