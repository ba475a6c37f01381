"""coloc bench: how fast worlds, faces and localizers are, beside other environments."""
