"""Other ways to answer the question of the blind check, on the same folders, scored alike."""
