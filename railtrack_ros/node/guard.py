"""A node does not die of a message: it says what is wrong with it, counts it, and goes on."""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from railtrack_ros.errors import InputError

# Shortest time between two lines about one thing, s.
QUIET_PERIOD = 5.0

# Things that are remembered; beyond it the limit begins anew.
MOST_THINGS = 1000


class Voice:
    """Says a thing at once, and then at most every :data:`QUIET_PERIOD` seconds.

    Remarks that differ only in their numbers are about the same thing. A later line tells how
    many were not said.

    Parameters
    ----------
    now
        Monotonic time, s.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._said: dict[str, float] = {}
        self._unsaid: Counter[str] = Counter()

    def say(self, text: str, say: Callable[[str], Any], thing: str | None = None) -> None:
        """Pass a remark on to `say`, or keep quiet; `thing` is what it is about."""
        thing = re.sub(r'[-+.\d]+', '#', text) if thing is None else thing
        if len(self._said) > MOST_THINGS:
            self._said.clear()
            self._unsaid.clear()
        now = self._now()
        if now - self._said.get(thing, -QUIET_PERIOD) < QUIET_PERIOD:
            self._unsaid[thing] += 1
            return
        more = f' ({self._unsaid[thing]} more since)' if self._unsaid[thing] else ''
        self._said[thing], self._unsaid[thing] = now, 0
        say(f'{text}{more}')


class Guard:
    """Calls functions on behalf of topics, with a count of the messages that were refused.

    Parameters
    ----------
    voice
        Limits how often it speaks.
    warn, fail
        Take a line about unusable input, and about a fault of this program.

    Attributes
    ----------
    refused
        Number of refused messages by topic.
    last
        Reason of the last refusal by topic.
    """

    def __init__(self, voice: Voice, warn: Callable[[str], Any], fail: Callable[[str], Any]
                 ) -> None:
        self._voice = voice
        self._warn = warn
        self._fail = fail
        self.refused: Counter[str] = Counter()
        self.last: dict[str, str] = {}

    def call(self, topic: str, function: Callable[..., None], *arguments: Any) -> bool:
        """Call `function`; return whether it took the message that came on `topic`."""
        try:
            function(*arguments)
            return True
        except InputError as error:
            self._refuse(topic, str(error), self._warn)
        except Exception as error:
            # A fault of this program; the stream of measurements is worth more than it.
            self._refuse(topic, f'unexpected {error!r}', self._fail)
        return False

    def _refuse(self, topic: str, reason: str, say: Callable[[str], Any]) -> None:
        self.refused[topic] += 1
        self.last[topic] = reason
        self._voice.say(f'{topic}: message skipped: {reason}', say, thing=topic)
