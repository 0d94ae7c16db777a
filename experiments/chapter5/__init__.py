"""Chapter 5: what is known of the rig's stability before a controller flies it."""
