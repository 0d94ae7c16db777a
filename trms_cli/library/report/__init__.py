"""What a report page is of: runs, comparisons and sweeps, read for `reporting`."""
