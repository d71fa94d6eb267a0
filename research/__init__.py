"""Programs that computed the package's data files. They run from the source tree only."""
