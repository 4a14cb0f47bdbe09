"""Pairs of tracks and measurements with the least sum of distances."""

import numpy as np

from curio_serve.imaging.rotation import Array


def assigned(distance: Array) -> dict[int, int]:
    """Column by row, as many pairs as the smaller side has, with the least sum (Kuhn 1955, by shortest paths).

    Args:
        distance: [rows, columns], finite.
    """
    if distance.shape[0] > distance.shape[1]:
        return {row: column for column, row in assigned(distance.T).items()}
    num_rows, num_columns = distance.shape
    of_row, of_column = np.zeros(num_rows), np.zeros(num_columns)  # dual prices
    row_of = np.full(num_columns, -1)
    for free in range(num_rows):
        shortest, before = np.full(num_columns, np.inf), np.full(num_columns, -1)
        visited, row, last, length = np.zeros(num_columns, bool), free, -1, 0.0
        while row >= 0:
            reduced = length + distance[row] - of_row[row] - of_column
            nearer = ~visited & (reduced < shortest)
            shortest[nearer], before[nearer] = reduced[nearer], last
            last = int(np.where(visited, np.inf, shortest).argmin())
            length, visited[last], row = float(shortest[last]), True, int(row_of[last])
        changed = visited & (row_of >= 0)
        of_row[free] += length
        of_row[row_of[changed]] += length - shortest[changed]
        of_column[visited] -= length - shortest[visited]
        while last >= 0:
            row_of[last] = free if before[last] < 0 else row_of[before[last]]
            last = int(before[last])
    return {int(row): int(column) for column, row in enumerate(row_of) if row >= 0}
