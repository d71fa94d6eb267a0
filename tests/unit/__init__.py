"""Tests in one process: no process, pseudo-terminal or real-time daemon is started."""
