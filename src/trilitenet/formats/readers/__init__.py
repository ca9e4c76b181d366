"""Readers of foreign data sets: one file a format, each giving image records for the conversion."""
