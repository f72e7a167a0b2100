"""One run, from the name of a sequence to a folder of results, and how it goes on later."""
