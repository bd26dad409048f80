"""The process of a program: compilation cache, memory pages, signals, standard output,
names of files as text."""
