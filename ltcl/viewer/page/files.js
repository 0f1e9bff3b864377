// SPDX-License-Identifier: BSD-3-Clause
// Pictures that Python has, and files that are opened or dropped.

export function files(app) {
  const { $, every, frame, ask, say, views, connection, hear } = app;

  async function known() {
    const answer = await ask("pictures");
    if (answer) app.pictures = answer.pictures;
    for (const select of every("select[id$=source]")) {
      const chosen = select.value, first = select.dataset.first ? [new Option(select.dataset.first, "")] : [];
      select.replaceChildren(...first, ...(app.pictures ?? []).map(({ picture, name }) => new Option(name, picture)));
      select.value = chosen;
      if (select.selectedIndex < 0) select.selectedIndex = 0;
    }
  }

  // What becomes of pictures of other proportions: one choice for all views, which the one in sight follows.
  const resizes = every("select[id$=resize]");
  for (const select of resizes) {
    select.onchange = () => {
      for (const other of resizes) other.value = select.value;
      const source = $(`${app.current}-source`);
      if (source.value) source.dispatchEvent(new Event("change"));
    };
  }

  // Give a file to the view in sight: it takes it itself, or Python does, and the view gets its number.
  async function give(file) {
    const view = app.current;
    if (!app.hello.grid) throw new Error("there is no transport yet, and pictures are for one");
    if (await views[view].take?.(file)) return;
    if (file.size > app.hello.largest_file) throw new Error(`it has ${file.size} bytes, which is too many`);
    const content = new Uint8Array(await file.arrayBuffer());
    const answer = await connection.ask("upload", { name: file.name }, { content });
    await known();
    const select = $(`${view}-source`);
    if (!answer || !select || view !== app.current) return;
    select.value = answer.picture;
    select.dispatchEvent(new Event("change"));
  }

  const open = (file) => give(file).catch(({ message }) => say(`${file.name}: ${message}`, "pictures"));

  for (const input of every("input[type=file]")) {
    input.onchange = () => {
      if (input.files[0]) open(input.files[0]);
      input.value = ""; // so that the same file can be opened again
    };
  }

  // What is dropped here is for nobody else.
  const area = app.embedded ? frame : window;
  const dropping = (on) => (event) => {
    event.preventDefault();
    if (app.embedded) event.stopPropagation();
    frame.classList.toggle("dropping", on);
  };
  hear(area, "dragover", dropping(true));
  hear(area, "dragleave", dropping(false));
  hear(area, "drop", (event) => {
    dropping(false)(event);
    if (event.dataTransfer.files[0] && app.current) open(event.dataTransfer.files[0]);
  });
  return known;
}
