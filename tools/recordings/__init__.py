"""Record the stream in MCAP files, and replay and export recordings.

Messages are stored as JSON with the topic's schema (`wire.schema_docs.json_schema`), so Foxglove
and PlotJuggler can open the file. Floats are stored with all digits, and NaN as null. Each finger
has its own channel of tactile frames, which are stored as ``foxglove.RawImage`` with the topic's
fields added. Log times are the messages' Unix times. The packages of the ``record`` extra are
required and are imported when a file is opened.
"""
