"""Programs that computed the package's data files. They can be run only from the source tree."""
