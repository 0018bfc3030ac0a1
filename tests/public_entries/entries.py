"""Every public entry with arguments that work, and what kind each argument is."""

import inference_entries
import log_entries
import named_entries
import simulation_entries

TABLES = (inference_entries, simulation_entries, log_entries, named_entries)
ENTRIES = {name: entry for table in TABLES for name, entry in table.ENTRIES.items()}
