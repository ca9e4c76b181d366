"""Labelled frames: reading, transforms, batches, synthetic scenes."""
