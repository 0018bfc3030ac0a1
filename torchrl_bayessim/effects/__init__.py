"""Effects that simulators leave out: a catalogue, each with one strength that is off at zero."""
