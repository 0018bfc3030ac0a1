"""How logs of a robot come in: its description, reading, resampling and a sanity gate."""
