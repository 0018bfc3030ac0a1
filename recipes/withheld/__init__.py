"""Blind check of the gap diagnosis: a generator of its own, sealed labels, and scores."""
