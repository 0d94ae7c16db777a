"""One module a reader: ``seeds(folder)`` and ``read(data, folder)``."""
