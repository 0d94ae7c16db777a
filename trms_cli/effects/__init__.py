"""What real rigs have and the nominal model lacks."""
