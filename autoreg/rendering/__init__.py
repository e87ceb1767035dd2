"""From an aligned photo and a description of objects to the final picture."""
