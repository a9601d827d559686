"""Plain-text progress that reads well in a terminal, a log and a notebook alike."""

import time


def track(items, total, description, every=5.0):
    """Yield from `items`, printing a line with the time left at most every few seconds.

    Parameters
    ----------
    items : iterable of (int, object)
        Pairs of the amount of work done by this item, and the item itself, which is passed on.
    total : int
        Work in all.
    description : str
        What is being done, and in which unit: ``"inflating structures"``.
    every : float
        Seconds between two lines; short work prints nothing.
    """
    started = last = time.monotonic()
    done = 0
    for amount, item in items:
        yield item
        done += amount
        now = time.monotonic()
        if now - last >= every:
            last = now
            left = (now - started) / done * (total - done)
            print(f"{description}: {done} of {total} ({100 * done // total} %), {left:.0f} s left", flush=True)
