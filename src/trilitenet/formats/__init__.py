"""Readers and writers of the file formats other tools use."""
