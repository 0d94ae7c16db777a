"""Chapter 3: networks as models of the rig, thirteen ways to train them."""
