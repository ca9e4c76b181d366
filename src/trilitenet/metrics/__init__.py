"""Metrics: update, compute, reset; the published protocol and a fair one, named as such."""
