"""The process a program runs in: compilation cache, memory pages, signals, standard output."""
