"""Parts that scenario families have in common, and parts too long for a family's own file."""
