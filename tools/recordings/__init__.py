"""Recordings of the stream in MCAP files: writing, reading, mending.

A message is kept as JSON with the schema of its topic (`wire.schema_docs.json_schema`), so that
Foxglove and PlotJuggler open the file; a float keeps all its digits, and a float that is no number
is null. Tactile frames are images there: one channel a finger, ``foxglove.RawImage`` with the
topic's own fields beside it. Log times are the messages' Unix times.

Needs mcap, orjson and zstandard, the extra ``record``; nothing here imports them before
they are needed.
"""
