"""Places seen again: what they say of the path in between."""
