"""The tournament: controllers × observers × references × rigs, ranked with intervals."""
