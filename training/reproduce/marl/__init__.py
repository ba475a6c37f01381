"""What policies learn in the environment, beside the filters and the bound."""
