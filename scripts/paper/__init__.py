"""The two experiments of the paper, section 3."""
