"""Files that other programs read: MCAP run logs, CSV recordings, Parquet and MAT exports.

The only room that knows file formats. It stands beside the others: commands, replayed
plants and scoring read through it, and it imports nothing of them.
"""
