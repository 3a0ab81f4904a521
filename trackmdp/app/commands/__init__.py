"""The commands, each called with a checked config and a folder for its files."""

from trackmdp.deferred import defer_compiler

defer_compiler()  # before a command imports torch, also in the server from which the runs of a sweep are forked
