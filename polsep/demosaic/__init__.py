"""Demosaicking: all analysers in all colours at common points; every kernel lies beside its readable twin."""
