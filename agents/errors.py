"""What localizers refuse."""


class NotServed(ValueError):
    """A team is one that a localizer cannot estimate: it measures nothing that it could use, say.
    Raised where the localizer is built; no option or name is wrong."""
