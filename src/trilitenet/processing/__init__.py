"""NumPy and OpenCV only: letterbox and its exact inverse, box maths, NMS, post-processing, drawing."""
