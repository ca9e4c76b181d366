"""One typed, documented function a verb: the Python API, from which the command line is generated."""
