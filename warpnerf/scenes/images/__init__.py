"""Photographs, masks and depths, and where their pixels are kept."""
