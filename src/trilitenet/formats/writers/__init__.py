"""Writers: perceptions into files that other tools read, one file a format; `open_writer` picks one by name."""
