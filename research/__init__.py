"""Programs that compute the package's data files; run the programs from the source tree."""
