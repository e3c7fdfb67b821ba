"""Whether it pays to step a batch of foreign environments in several processes."""

DECISION_SECONDS = 0.005
"""Time of a decision of the whole batch from which on processes pay: to ask them and to wait for
the answers takes about a tenth of this."""
EPISODE_SECONDS = 2.0
"""Time of a batch of the longest episodes from which on they pay: about what they take to begin."""


def pay(seconds: float, decisions: int) -> bool:
    """Tell whether processes are quicker for a batch of which a decision takes so many seconds in
    one process, and the longest episode has so many decisions.
    """
    return seconds >= DECISION_SECONDS and seconds * decisions >= EPISODE_SECONDS
