"""Measuring this machine: one function per part of `trackmdp benchmark`, each returning its rows."""
