"""Whether recordings can tell what is asked of them."""
