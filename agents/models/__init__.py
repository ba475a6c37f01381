"""Motion and measurement models that localizers share."""
