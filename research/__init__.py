"""Programs that compute the package's data files; run them from the source tree."""
