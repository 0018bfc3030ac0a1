"""Where the parameters go: adapters that write exact values and read them back."""
