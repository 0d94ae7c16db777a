"""Chapter 4: grey-box models, white against grey in eleven cases, and methods compared."""
