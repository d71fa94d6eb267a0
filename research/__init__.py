"""Programs that computed what the package only reads; run from the tree, never installed."""
