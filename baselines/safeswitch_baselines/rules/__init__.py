"""Switch rules that compete: signal x calibrator x return rule, one class a rule."""
