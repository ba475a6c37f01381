"""One HTML file about one or several evaluations, which needs no network and no server."""
