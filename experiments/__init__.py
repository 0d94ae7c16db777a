"""The studies: a folder each, with its configuration, its README and its expected figures."""
