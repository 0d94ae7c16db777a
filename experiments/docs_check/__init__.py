"""Every table and picture of the pages: what made it, when, and whether it comes out again."""
