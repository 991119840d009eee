"""The figures of the thesis computed again, and the page that holds them against it."""
