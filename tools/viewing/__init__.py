"""The command `view`: show the stream or a recording on a web page, and serve it to Foxglove."""
