"""An example package: a scenario, a localizer and a training of one's own."""
