"""Prediction: one backend a runtime, the predictor in front of them, and video."""
