"""The studies: a folder each, with its configuration, its README and what it is expected to show."""
