"""Policies and the networks behind them."""
