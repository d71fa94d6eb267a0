"""`view`: the stream, or a recording, on a web page; the stream for Foxglove."""
