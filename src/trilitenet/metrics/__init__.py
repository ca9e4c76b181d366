"""Metrics: update, compute; the published protocol and a fair one, named as such."""
