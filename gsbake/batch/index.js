// Sorts the table by the column whose heading is selected; a second time in the other direction.
const body = document.querySelector("tbody");
for (const button of document.querySelectorAll("th button")) {
  button.addEventListener("click", () => {
    const column = button.parentElement.cellIndex;
    const down = button.dataset.order !== "down";
    button.dataset.order = down ? "down" : "up";
    const key = (row) => row.cells[column].dataset.sort;
    const figures = [...body.rows].every((row) => !isNaN(key(row)));
    const compare = (a, b) => (figures ? key(b) - key(a) : key(a).localeCompare(key(b), undefined, { numeric: true }));
    const rows = [...body.rows].sort((a, b) => (down ? compare(a, b) : compare(b, a)));
    body.append(...rows);
  });
}
