"""`record`, `replay` and `export`: recordings of the stream in MCAP files.

A message is JSON with the schema of its topic (`wire.schema_docs.json_schema`), so that Foxglove
and PlotJuggler open the file; floats keep all their digits, NaN is null. Tactile frames are images:
one channel a finger, ``foxglove.RawImage`` with the topic's own fields beside it. Log times are the
messages' Unix times. Needs the extra ``record``, imported when a file is opened.
"""
