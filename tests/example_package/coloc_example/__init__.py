"""An example package: a sensor, scenarios, a localizer and a training of one's own."""
