"""The model of a campaign and its fit, shared by identification and diagnosis."""
