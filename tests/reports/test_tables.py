"""Tables as HTML, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator

from trackmdp.reports.tables import Cell, Column, Table

TABLE = Table(
    "a",
    "Policies & <prices>",
    [Column("policy"), Column("AIHTR", 2), Column("share", 1, "%"), Column("n"), Column("good")],
    [["Q_MDP <b>", 1234.5678, 1 / 3, 5, True], ["none", -0.001, float("nan"), None, False]],
)


def test_csv_keeps_every_digit() -> None:
    rows = list(csv.reader(io.StringIO(TABLE.csv())))
    assert rows[0] == ["policy", "AIHTR", "share (%)", "n", "good"]
    assert [float(rows[1][1]), float(rows[1][2])] == [1234.5678, 1 / 3]
    assert rows[2][2:4] == ["", ""]


def test_cells_are_shown_to_the_digits_asked_for() -> None:
    shown = [
        [column.text(value) for column, value in zip(TABLE.columns, row, strict=True)]
        for row in TABLE.rows
    ]
    assert shown == [["Q_MDP <b>", "1,234.57", "0.3", "5", "yes"], ["none", "0.00", "–", "–", "no"]]
    assert Column("x", 2).text(-1.5) == "−1.50"


def test_html_escapes_what_it_shows_and_sorts_by_what_it_hides() -> None:
    text = TABLE.html()
    assert "<b>" not in text
    assert "Q_MDP &lt;b&gt;" in text
    assert 'data-v="1234.5678">1,234.57<' in text
    assert text.count('<th scope="col"') == text.count('<button type="button">') == 5
    assert "<td>yes</td>" in text
    assert "<caption>Policies &amp; &lt;prices&gt;</caption>" in text


class Counted(list[list[Cell]]):
    """Rows that count how often somebody goes through all of them."""

    passes = 0

    def __iter__(self) -> Iterator[list[Cell]]:
        self.passes += 1
        return super().__iter__()


def test_a_table_is_written_in_a_time_that_grows_with_its_rows() -> None:
    passes = []
    for count in (3, 30):
        rows = Counted([["a", 1.0]] * count)
        table = Table("t", "", [Column("x"), Column("y")], rows)
        assert len(table.html()) > count
        assert len(table.latex()) > count
        passes.append(rows.passes)
    assert passes[0] == passes[1]


def test_latex_escapes_and_has_as_many_cells_as_columns() -> None:
    lines = TABLE.latex().splitlines()
    assert lines[1] == r"\begin{tabular}{lrrrl}"
    rows = [line for line in lines if line.endswith(r"\\")]
    assert len(rows) == 3
    assert all(row.count(" & ") == 4 for row in rows)
    assert r"Q\_MDP" in rows[1]
    assert r"share (\%)" in rows[0]


def test_a_column_without_values_is_in_the_file_alone() -> None:
    table = Table("t", "", [Column("x"), Column("y")], [[1.0, None], [2.0, float("nan")]])
    assert ">y<" not in table.html() and "textbf{y}" not in table.latex()
    assert table.csv() == "x,y\n1.0,\n2.0,\n"


def test_latex_letters_are_letters() -> None:
    table = Table("t", "a\ncaption", [Column("x")], [["\\ { } $ ~ ^ & % # _"]])
    lines = table.latex().splitlines()
    assert lines[0] == "% a caption"
    assert lines[5] == (
        r"\textbackslash{} \{ \} \$ \textasciitilde{} \textasciicircum{} \& \% \# \_ \\"
    )
    names = Table("t", "", [Column("x")], [["a <= b | c"], ["[red]"], ["*"]]).latex().splitlines()
    assert names[5:8] == [r"a $<$= b $|$ c \\", r"{[}red] \\", r"{*} \\"]


def test_a_cell_of_a_spreadsheet_is_no_formula() -> None:
    rows = [[evil] for evil in ("=1+1", "+1", "-1", "@SUM(1)", "\t=1")]
    lines = Table("t", "", [Column("x")], rows).csv().splitlines()
    assert lines[1:] == [f"'{row[0]}" for row in rows]
    assert Table("t", "", [Column("x")], [[-1.5]]).csv() == "x\n-1.5\n"
