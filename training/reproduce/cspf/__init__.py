"""The report on the collaborative Stein particle filter: its claims, outliers, and what lies
beyond."""
