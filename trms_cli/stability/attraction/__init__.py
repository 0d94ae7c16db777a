"""Regions of attraction: what is proved by intervals and LMIs, and what simulation shows."""
