"""Training and evaluation: the loop, the optimiser, EMA, checkpoints, reports."""
