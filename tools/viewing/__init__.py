"""What ``softfinger view`` shows and how: the stream turned into Rerun's entities."""
