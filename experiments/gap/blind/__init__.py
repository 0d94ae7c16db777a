"""The blind benchmark: rigs from other code than the models', and the judgement of diagnoses."""
