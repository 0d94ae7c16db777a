"""The proof of the gap watch: false alarms, delays and onsets on rigs that no model describes."""
