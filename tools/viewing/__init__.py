"""Implement `view`, which shows the stream or a recording on a web page and in Foxglove."""
