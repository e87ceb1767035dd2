"""From a found paving to the answer, or to the reason why there is none."""
