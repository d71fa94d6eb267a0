"""`view`: the stream, or a recording, turned into Rerun's entities."""
