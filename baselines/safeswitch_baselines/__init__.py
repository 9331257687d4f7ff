"""SafeSwitch baselines: learners, signals and switch rules that compete on the benchmark. Imports `safeswitch`, never the reverse."""
