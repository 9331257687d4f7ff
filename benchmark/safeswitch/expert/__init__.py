"""The expert: model-predictive control by differential dynamic programming, generated as C code.

`codegen` turns CasADi functions into compiled libraries, `ddp` generates the solver, `mpc` drives it in a receding
horizon, and each `*_model` module states one task's dynamics and cost. Import what is needed from those modules:
this package imports nothing by itself, so that `import safeswitch` stays cheap.
"""
