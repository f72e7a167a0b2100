"""The one error a user of the generator can meet."""


class SynthError(Exception):
    """What was asked for cannot be generated; the sentence says what to do instead."""
