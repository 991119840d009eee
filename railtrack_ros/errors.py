"""The one exception for input that cannot be used."""


class InputError(Exception):
    """Input that cannot be used, told in one line.

    The message names the file, topic, key or option at fault and what was expected of it.
    Commands print it on standard error and end with exit status 2.
    """

    def __init__(self, message: str) -> None:
        super().__init__(' '.join(str(message).split()))
