"""Recordings of the stream in MCAP files: `record`, `replay` and `export`.

Messages are stored as JSON with the schema of their topic (`wire.schema_docs.json_schema`), so that
Foxglove and PlotJuggler open the file. Floats keep all digits, and NaN is stored as null. Tactile
frames are stored as ``foxglove.RawImage`` with the topic's own fields added, in one channel per
finger. Log times are the messages' Unix times. The extra ``record`` is required; it is imported
when a file is opened.
"""
