"""The programs beside the flight, one package a command."""
