"""Record the stream in MCAP files, and replay, analyse, plot and export recordings.

Messages are stored as JSON with the topic's schema (`wire.schema_docs.json_schema`), so Foxglove
and PlotJuggler can open the file. Floats are stored with all digits, and NaN is stored as null.
Each finger has its own channel for tactile frames. A frame is stored as ``foxglove.RawImage`` with
the topic's fields added. The log time of a message is its Unix time. The ``record`` extra is
required, and its packages are imported when a file is opened.
"""
