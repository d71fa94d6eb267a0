"""Programs for computing the package's data files; they run only from the source tree."""
