// Where the page is: a capture and a tab, in the fragment of the address.
export const NAMES = ["photos", "masks", "setup", "run", "asset"];

export const go = (name, tab = "photos") => { location.hash = name ? `#/${encodeURIComponent(name)}/${tab}` : "#/"; };

export const place = () => {
  const [, name, tab] = location.hash.split("/");
  try {
    return { name: name ? decodeURIComponent(name) : "", tab: NAMES.includes(tab) ? tab : NAMES[0] };
  } catch {
    return { name: "", tab: NAMES[0] };
  }
};
