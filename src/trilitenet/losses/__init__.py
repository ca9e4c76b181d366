"""The losses of Section III-C: detection, segmentation, and their weighted sum."""
